"""Uncertainty from the form of the model, in addition to that from noise.

The relative sd of the mass is at least FORM_SD on any road. The forms of effects are approximate too: a fan speeds up
within seconds and turns on after release, tyres warm with speed. No drive shows evidence of a hundredth of an effect,
but a hundredth of a fan of 59 kW moves A by 2 standard deviations.
"""

import numpy as np

from estimator.estimation.road_likelihood import ROAD_LOAD
from estimator.signals import Floats

FORM_SD = 0.0025  # relative sd of 1/m from the form of the model on any road (friction in steps of 1 %)
EFFECT_DOUBT = 0.03  # sd of an effect from its form, as a share of it: the worst of four fans was off by 5 %
ROAD_DOUBT = 0.8  # sd of A / m and C / m added over hidden hills, over their sd: real roads are no Matern process


def with_doubt_of_form(beta: Floats, covariance: Floats, slope_sd: float, hidden: bool) -> Floats:
    """Return the covariance (p, p) of beta (p,), with the uncertainty from the form of the model added.

    The relative error is common to 1 / m, A / m and C / m, so it changes the mass and not A or C. On ``hidden`` roads
    an independent sd of ROAD_DOUBT times theirs is added to A / m and C / m, in proportion to ``slope_sd`` up to 0.4 %.
    """
    form = FORM_SD * np.concatenate([beta[:ROAD_LOAD], np.zeros(len(beta) - ROAD_LOAD)])
    wider = covariance.copy()
    if hidden:
        swamped = ROAD_DOUBT * min(slope_sd / 4e-3, 1.0)
        wider[1:ROAD_LOAD, 1:ROAD_LOAD] *= 1 + swamped**2
    return wider + np.outer(form, form)


def with_doubt_of_effects(beta: Floats, covariance: Floats, effects: int) -> Floats:
    """Return the covariance (p, p) of beta (p,), with a relative sd EFFECT_DOUBT added to each of the last ``effects``.

    The other coefficients move by their regression on the effect's coefficient: the part of a large effect that
    resembles A and C moves them, however well the drive determines all three.
    """
    wider = covariance.copy()
    for place in range(len(beta) - effects, len(beta)):
        shift = covariance[:, place] / covariance[place, place] * (EFFECT_DOUBT * beta[place])
        wider += np.outer(shift, shift)
    return wider

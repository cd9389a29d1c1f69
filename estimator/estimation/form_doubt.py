"""What the form of the model leaves in doubt, beyond what noise does.

A floor for the sd of the mass (FORM_SD) holds on any road. Effects have a form of their own: a fan speeds up within
seconds and turns while it is released, tyres warm with speed. No drive shows evidence of a hundredth of an effect; a
hundredth of a fan of 59 kW moves A by 2 standard deviations.
"""

import numpy as np

from estimator.estimation.road_likelihood import ROAD_LOAD
from estimator.signals import Floats

FORM_SD = 0.0025  # relative sd of 1/m from the form of the model on any road (friction in steps of 1 %)
EFFECT_DOUBT = 0.03  # sd of an effect from its form, as a share of it: the worst of four fans was off by 5 %
ROAD_DOUBT = 0.8  # share of their sd by which A / m and C / m are wider there: real roads are no Matern process


def with_doubt_of_form(beta: Floats, covariance: Floats, slope_sd: float, hidden: bool) -> Floats:
    """The covariance (p, p) of beta (p,), with the uncertainty from the form of the model added.

    A / m and C / m are proportional to 1 / m, so an error of the form changes the mass alone. Over hidden hills the sd
    of A and C is larger by ROAD_DOUBT, in proportion to the slopes up to an sd of 0.4 %.
    """
    form = FORM_SD * np.concatenate([beta[:ROAD_LOAD], np.zeros(len(beta) - ROAD_LOAD)])
    wider = covariance.copy()
    if hidden:
        swamped = ROAD_DOUBT * min(slope_sd / 4e-3, 1.0)
        wider[1:ROAD_LOAD, 1:ROAD_LOAD] *= 1 + swamped**2
    return wider + np.outer(form, form)


def with_doubt_of_effects(beta: Floats, covariance: Floats, effects: int) -> Floats:
    """The covariance (p, p) of beta (p,), with each of the last ``effects`` uncertain by EFFECT_DOUBT of itself.

    The other coefficients follow as the data make them follow: a large effect moves A and C by what little of it looks
    like them, however well the drive determines all three.
    """
    wider = covariance.copy()
    for place in range(len(beta) - effects, len(beta)):
        shift = covariance[:, place] / covariance[place, place] * (EFFECT_DOUBT * beta[place])
        wider += np.outer(shift, shift)
    return wider

"""What the form of the model leaves in doubt, beyond what noise does.

The likelihood takes the force as given when a slope begins. Drivers and governors answer a share k of it within the
same stride: the force changes by k m g times the change of the slope, the speed by less, and the mass comes out too
large by

    k R,   R = g^2 var(change of the slope) / var(change of the acceleration by the driver) = n (s^2 - s_level^2)

with n strides of the present load, the relative sd s of the mass, and s_level that on a road known to be level. The
share is that of ANSWERED; above MAX_HIDDEN_CHANGES the first order does not hold, and s is large by itself. A floor for
the sd of the mass (FORM_SD) holds on any road.

Effects have a form of their own: a fan speeds up within seconds and turns while it is released, tyres warm with speed.
No drive shows evidence of a hundredth of an effect; a hundredth of a fan of 59 kW moves A by 2 standard deviations.
"""

import numpy as np

from estimator.estimation.road_likelihood import ROAD_LOAD, Likelihood
from estimator.model.road_scales import SLOPE
from estimator.signals import Floats

FORM_SD = 0.0025  # relative sd of 1/m from the form of the model on any road (friction in steps of 1 %)
ANSWERED, ANSWERED_SD = 0.3, 0.2  # share of a slope's change that drivers answer in its stride (simulated one: 0.45)
MAX_HIDDEN_CHANGES = 1.0  # of R that is allowed for: the mass falls by 23 %, with an sd of 20 %
EFFECT_DOUBT = 0.03  # sd of an effect from its form, as a share of it: the worst of four fans was off by 5 %
ROAD_DOUBT = 0.8  # share of their sd by which A / m and C / m are wider there: real roads are no Matern process


def with_doubt_of_form(beta: Floats, covariance: Floats, answered: float, slope_sd: float, hidden: bool) -> Floats:
    """The covariance (p, p) of beta (p,), with the uncertainty from the form of the model added.

    A / m and C / m are proportional to 1 / m, so an error of the form changes the mass alone; ``answered`` is the sd of
    1/m by what drivers answer. Over hidden hills the sd of A and C is larger by ROAD_DOUBT, in proportion to the slopes
    up to an sd of 0.4 %.
    """
    share = float(np.hypot(FORM_SD, answered))
    form = share * np.concatenate([beta[:ROAD_LOAD], np.zeros(len(beta) - ROAD_LOAD)])
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


def hidden_changes(likelihood: Likelihood, scales: Floats, information: Floats, inverse_mass: float) -> float:
    """R of the module: variance of the slope's changes that no signal shows, over that of the driver's changes.

    It is of the present load, whose mass is asked for. Coefficients of terms are held: what they share with 1/m is not
    hidden by slopes. ``scales`` (k,) of road and noise; ``information`` (p, p) and ``inverse_mass`` in the likelihood's
    own units.
    """
    t = likelihood.model.driven.t
    present = np.count_nonzero(t >= max(likelihood.departures, default=-np.inf))
    level = scales.copy()
    level[SLOPE] = likelihood.model.scales[SLOPE].low
    gram = likelihood.model.condition(level).gram(likelihood.data)
    _, without, _ = likelihood.solve(gram)
    base = len(information) - len(likelihood.terms)
    variances = [float(np.linalg.inv(each[:base, :base])[0, 0]) for each in (information, without)]
    found = present * (variances[0] - variances[1]) / inverse_mass**2
    return float(np.clip(found, 0.0, MAX_HIDDEN_CHANGES))

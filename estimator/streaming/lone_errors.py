"""Isolated readings of speed that no vehicle can reach, between two readings that agree with each other."""

import numpy as np

from estimator.signals import Floats, Mask

MAX_ACCELERATION = 12.0  # m/s^2: tyres on a dry road transmit 8 to 11
MIN_ERROR = 0.5  # m/s, more than noise and resolution
MIN_ERROR_SHARE = 2.0  # times the difference between the neighbours, which else are in doubt too


def lone_errors(t: Floats, speed: Floats) -> Mask:
    """Mask (n,) of readings that cannot be true, given their neighbours.

    Parameters
    ----------
    t
        Times [s] (n,), ascending.
    speed
        Readings [m/s] (n,); NaN where not valid.

    Let b and a be the intervals [s] to the neighbours before and after. With acceleration at most MAX_ACCELERATION,
    speed lies within 2 MAX_ACCELERATION b a / (b + a) of the straight line between them.
    """
    wrong = np.zeros(len(t), dtype=bool)
    if len(t) < 3:
        return wrong
    before, after = t[1:-1] - t[:-2], t[2:] - t[1:-1]
    span, change = before + after, speed[2:] - speed[:-2]
    off = np.abs(speed[1:-1] - speed[:-2] - change * before / span)
    limit = MIN_ERROR + 2 * MAX_ACCELERATION * before * after / span
    with np.errstate(invalid="ignore"):
        wrong[1:-1] = (off > limit) & (off > MIN_ERROR_SHARE * np.abs(change))
    return wrong

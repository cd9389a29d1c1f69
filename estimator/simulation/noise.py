"""Random processes at equal steps, from a passed generator."""

from itertools import accumulate
from math import exp, sqrt

import numpy as np

from estimator.signals import Floats


def correlated(steps: int, sd: float, correlation_steps: float, rng: np.random.Generator) -> Floats:
    """Stationary first-order autoregressive noise (steps,).

    Parameters
    ----------
    steps
        Number of values.
    sd
        Standard deviation, in the unit of the result.
    correlation_steps
        Steps after which the autocorrelation has fallen to 1/e.
    rng
        Source of randomness.
    """
    keep = exp(-1.0 / correlation_steps)
    shocks = rng.normal(0.0, sd * sqrt(1.0 - keep * keep), steps)
    shocks[0] = rng.normal(0.0, sd)
    return np.array(list(accumulate(shocks.tolist(), lambda value, shock: keep * value + shock)))


def smooth(steps: int, sd: float, correlation_steps: float, rng: np.random.Generator) -> Floats:
    """Smooth noise (steps,) of standard deviation ``sd``: first-order noise after a first-order low-pass."""
    rough = correlated(steps, sd * sqrt(2.0), correlation_steps, rng)
    gain = 1.0 - exp(-1.0 / correlation_steps)
    return np.array(list(accumulate(rough.tolist(), lambda value, target: value + gain * (target - value))))

"""Mean and covariance of a mixture of Gaussians relative to one of them: the law of total variance.

With w_i the probabilities of alternatives and d_i their means less that of the reference, which has the rest of the
probability, w_0 = 1 - sum w_i and d_0 = 0,

    shift = sum w_i d_i,   spread = sum_{i >= 0} w_i (d_i - shift) (d_i - shift)'
"""

import numpy as np

from estimator.signals import Floats


def between(weights: Floats, shifts: Floats) -> tuple[Floats, Floats]:
    """Shift (p,) of the mean and covariance (p, p) between alternatives of ``weights`` (k,) and ``shifts`` (k, p)."""
    shift: Floats = weights @ shifts
    apart = shifts - shift
    rest = 1.0 - float(weights.sum())
    spread: Floats = (apart.T * weights) @ apart + max(rest, 0.0) * np.outer(shift, shift)
    return shift, spread

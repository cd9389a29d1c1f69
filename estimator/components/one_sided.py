"""Compute moments of Gaussian distributions truncated at zero, for magnitudes that cannot be negative."""

from collections.abc import Iterable

import numpy as np
from scipy.special import log_ndtr

from estimator.signals import Floats


def above_zero(value: Floats, sd: Floats) -> tuple[Floats, Floats]:
    """Mean and sd (c,) of N(``value``, ``sd``^2) truncated to positive values."""
    at = value / sd
    raised = np.exp(-0.5 * at**2 - 0.5 * np.log(2 * np.pi) - log_ndtr(at))  # normal density over its integral
    return value + sd * raised, sd * np.sqrt(np.maximum(1 - raised * (raised + at), 0.0))


def log_evidence_of_sign(at: Floats | float) -> Floats:
    """Gain in log evidence of a half-Gaussian prior over the whole Gaussian; ``at``: posterior mean over sd."""
    gained: Floats = log_ndtr(at) + np.log(2)
    return gained


def cut_at_zero(mean: Floats, covariance: Floats, indices: Iterable[int]) -> tuple[Floats, Floats]:
    """Mean (p,) and covariance (p, p) of a Gaussian with the elements ``indices`` truncated at zero, one by one.

    The other elements change by their regression on the truncated one. The moments are exact for one element.
    """
    for i in indices:
        variance = covariance[i, i]
        value, sd = above_zero(mean[[i]], np.sqrt([variance]))
        along = covariance[:, i] / variance
        mean = mean + along * (value[0] - mean[i])
        covariance = covariance + np.outer(along, along) * (sd[0] ** 2 - variance)
    return mean, covariance

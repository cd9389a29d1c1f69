"""Log densities of parameters inside a box prior, evaluated for a batch of parameter vectors at once."""

from typing import Protocol

import numpy as np

from estimator.signals import Floats, Mask

MIN_VARIANCE_SHARE = 1e-12  # of the variances, added to them where a direction has none


class Target(Protocol):
    """Interface of a log density over parameter vectors, with local Gaussians for proposals."""

    @property
    def lower(self) -> Floats:
        """Lower bounds of the box prior (p,)."""
        ...

    @property
    def upper(self) -> Floats:
        """Upper bounds of the box prior (p,)."""
        ...

    @property
    def centre(self) -> Floats:
        """Point (p,) of highest density in the box."""
        ...

    def log_density(self, theta: Floats) -> Floats:
        """Unnormalised log density (k,) of ``theta`` (k, p); minus infinity outside the box."""
        ...

    def curvature(self, theta: Floats) -> Floats:
        """Covariances (k, p, p) of Gaussians that approximate the density near ``theta`` (k, p), in the box."""
        ...


def in_box(theta: Floats, lower: Floats, upper: Floats) -> Mask:
    """Mask (k,) of the rows of ``theta`` (k, p) that lie inside the box prior."""
    inside = np.ones(len(theta), dtype=bool)
    for column, low, high in zip(theta.T, lower, upper, strict=True):  # several times faster than all(axis=1)
        inside &= (column >= low) & (column <= high)
    return inside


def factor(covariance: Floats) -> Floats:
    """Lower Cholesky factors (..., p, p) of covariances (..., p, p); MIN_VARIANCE_SHARE is added to singular ones."""
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    scale = np.sqrt(np.maximum(variance, np.finfo(float).tiny))
    correlation = covariance / (scale[..., :, None] * scale[..., None, :])
    lower: Floats = scale[..., None] * np.linalg.cholesky(correlation + MIN_VARIANCE_SHARE * np.eye(scale.shape[-1]))
    return lower


def highest_in_box(precision: Floats, mean: Floats, lower: Floats, upper: Floats) -> Floats:
    """Mode (p,) in the box of a Gaussian of ``mean`` (p,) and ``precision`` (p, p), by bounded least squares."""
    if in_box(mean[None], lower, upper)[0]:
        return mean
    from scipy.optimize import lsq_linear  # takes as long to import as the rest of scipy; most boxes cut nothing

    scale = np.sqrt(np.diag(precision))
    root = factor(precision).T / scale
    solution = lsq_linear(root, root @ (mean * scale), (lower * scale, upper * scale), method="bvls")
    return np.clip(solution.x / scale, lower, upper)


def bound_precision(centre: Floats, slope: Floats, lower: Floats, upper: Floats) -> Floats:
    """Precision (p, p) that bounds at the mode add to a Gaussian that approximates the density.

    Away from a bound, the density falls exponentially with sd 1 / slope, where ``slope`` (p,) is the gradient of its
    logarithm. A proposal with twice that sd covers the tail.
    """
    at_bound = (centre <= lower) | (centre >= upper)
    return np.diag(np.where(at_bound, (slope / 2) ** 2, 0.0))

"""Log densities of the parameters, evaluated for a batch of them at once."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from estimator.signals import Floats, Mask


class Target(Protocol):
    """A log density over parameter vectors, with the local Gaussian that a proposal can be built from."""

    @property
    def centre(self) -> Floats:
        """Where the density is highest before the box cuts it (p,)."""
        ...

    def log_density(self, theta: Floats) -> Floats:
        """Unnormalised log density (k,) of ``theta`` (k, p); minus infinity outside the box."""
        ...

    def curvature(self, theta: Floats) -> Floats:
        """Covariance (p, p) of the local Gaussian approximation around ``theta`` (p,)."""
        ...


def in_box(theta: Floats, lower: Floats, upper: Floats) -> Mask:
    """Which rows of ``theta`` (k, p) lie inside the box prior."""
    inside: Mask = np.all((theta >= lower) & (theta <= upper), axis=1)
    return inside


@dataclass(frozen=True)
class StudentTarget:
    """Multivariate t around a fitted centre: a moment objective whose covariance had to be estimated.

    log p = -(dof + p) / 2 log(1 + d' V^-1 d / dof),  d = theta - centre

    With the covariance of the moments known it would be Gaussian (Chernozhukov & Hong 2003); estimating it from
    ``dof`` independent parts of the spectrum makes it t.
    """

    centre: Floats
    covariance: Floats
    dof: float
    lower: Floats
    upper: Floats

    def log_density(self, theta: Floats) -> Floats:
        """See `Target.log_density`."""
        scaled = np.linalg.solve(np.linalg.cholesky(self.covariance), (theta - self.centre).T)
        distance = np.einsum("ij,ij->j", scaled, scaled)
        density = -0.5 * (self.dof + len(self.centre)) * np.log1p(distance / self.dof)
        return np.where(in_box(theta, self.lower, self.upper), density, -np.inf)

    def curvature(self, theta: Floats) -> Floats:
        """See `Target.curvature`; the same everywhere."""
        return self.covariance


@dataclass(frozen=True)
class ClippedGaussianTarget:
    """The paper's likelihood: independent Gaussian residuals around power clipped at zero.

    log p = -chi2(theta) / (2 sigma^2),  chi2 = sum (P - max(X theta, 0))^2

    ``X`` (n, p) as from `road_load.design`; ``P`` (n,) [W]; ``centre`` (p,) the least-squares point and ``variance``
    sigma^2 [W^2], both from `clipped_least_squares`. The paper re-estimates
    sigma^2 = chi2 / (n - p) along the chain; fixed at the least-squares point, to which that settles, the chain has
    one invariant distribution from its first iteration on.
    """

    X: Floats
    P: Floats
    centre: Floats
    variance: float
    lower: Floats
    upper: Floats

    def chi2(self, theta: Floats) -> Floats:
        """Sum of squared residuals (k,) [W^2] for ``theta`` (k, p)."""
        residual = self.P[:, None] - np.maximum(self.X @ theta.T, 0.0)
        total: Floats = np.einsum("ij,ij->j", residual, residual)
        return total

    def log_density(self, theta: Floats) -> Floats:
        """See `Target.log_density`."""
        return np.where(in_box(theta, self.lower, self.upper), -self.chi2(theta) / (2 * self.variance), -np.inf)

    def curvature(self, theta: Floats) -> Floats:
        """See `Target.curvature`: sigma^2 (J' J)^-1 with J the Jacobian of the clipped power."""
        J = self.X[self.X @ theta > 0]
        return self.variance * np.linalg.pinv(J.T @ J, hermitian=True)


def clipped_least_squares(X: Floats, P: Floats, iterations: int = 50) -> tuple[Floats, float]:
    """Least squares of ``P`` (n,) on ``max(X theta, 0)``, and chi2 / (n - p) there.

    Gauss-Newton on the active samples; it settles in a few steps because the model is linear where it is not cut.
    """
    theta = np.linalg.lstsq(X, P, rcond=None)[0]
    active = np.ones(len(P), dtype=bool)
    for _ in range(iterations):
        previous, active = active, X @ theta > 0
        if np.array_equal(active, previous) or active.sum() <= X.shape[1]:
            break
        theta = np.linalg.lstsq(X[active], P[active], rcond=None)[0]
    residual = P - np.maximum(X @ theta, 0.0)
    return theta, float(residual @ residual) / max(len(P) - X.shape[1], 1)

"""The paper's likelihood, exact everywhere, at a cost per evaluation that does not grow with the number of samples.

    log p = -chi2(theta) / (2 sigma^2),   chi2 = sum (P - max(x . theta, 0))^2,   x = [v, v^3, v a]

Without the clip, chi2 would be a quadratic form of a few sums over the samples. Let theta = theta0 + L z, with
theta0 the clipped least-squares point and L L' = sigma^2 (J' J)^-1. Inside the ellipsoid |z| <= r a sample can change
sign only if |x . theta0| <= r |L' x|: a few dozen out of any number. Each of several nested ellipsoids keeps the sums
of the samples that are active throughout it, and drops those that are clipped throughout it. It evaluates the other,
undecided samples one by one. The outermost one is unbounded, and all its samples are undecided.

All quantities are relative to theta0 and in units of sigma, which avoids cancellation. Let u = x . theta0, w = L' x and
e = P - max(u, 0), the residual. The power of a sample changes by h = max(w . z + min(u, 0), -max(u, 0)), which adds
(h - e)^2 - e^2 to chi2.

Source: Miller, Konan, Duran, "Bayesian Parameter Estimation for Heavy-Duty Vehicles", NREL.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estimator.sampling.likelihood import bound_precision, factor, highest_in_box, in_box
from estimator.signals import Floats

RADII = (1.5, 2.5, 4.0, 8.0, 32.0, 128.0)  # sd, of the ellipsoids
MAX_ITERATIONS = 50  # of the least squares; a few are enough where the data determine the parameters
MIN_RESIDUAL_SHARE = 1e-9  # sd of the residual over the root mean square of the power: keeps exact data finite
BATCH = 2**15  # numbers evaluated at once, to fit the cache


@dataclass(frozen=True)
class Sums:
    """Sufficient statistics of least squares of ``y`` (n,) on ``X`` (n, p): G = X' X, b = X' y, s = y' y, and n."""

    G: Floats
    b: Floats
    s: float
    n: int

    @classmethod
    def of(cls, X: Floats, y: Floats) -> "Sums":
        """Compute the sums of samples ``X`` (n, p), ``y`` (n,)."""
        return cls(X.T @ X, X.T @ y, float(y @ y), len(y))

    @classmethod
    def empty(cls, p: int) -> "Sums":
        """Return the sums of no samples, for p columns."""
        return cls(np.zeros((p, p)), np.zeros(p), 0.0, 0)

    def __add__(self, other: "Sums") -> "Sums":
        return Sums(self.G + other.G, self.b + other.b, self.s + other.s, self.n + other.n)

    def __sub__(self, other: "Sums") -> "Sums":
        return Sums(self.G - other.G, self.b - other.b, self.s - other.s, self.n - other.n)

    @cached_property
    def _form(self) -> Floats:
        return np.block([[self.G, -self.b[:, None]], [-self.b, np.zeros(1)]])

    def excess(self, theta: Floats) -> Floats:
        """Sum of squares (k,) less that of theta = 0, for columns [theta, 1] (p + 1, k)."""
        total: Floats = np.einsum("ij,ij->j", self._form @ theta, theta)
        return total


def clipped_least_squares(X: Floats, P: Floats, lower: Floats, upper: Floats) -> tuple[Floats, Sums]:
    """Least-squares theta (p,) of P on ``max(X theta, 0)`` inside the box, and the sums of its active samples.

    Gauss-Newton iteration. It converges in a few steps because the model is linear where it is not clipped. Each step
    updates the sums by the samples that changed sign.
    """
    active = np.ones(len(P), dtype=bool)
    sums = Sums.of(X, P)
    weak = (upper - lower) ** -2.0
    for _ in range(MAX_ITERATIONS):
        # A weak prior determines the directions that the active samples do not.
        precision = sums.G + np.diag(MIN_RESIDUAL_SHARE**2 * (np.diag(sums.G) + sums.G.trace() * weak / weak.sum()))
        root = np.linalg.inv(factor(precision))
        theta = highest_in_box(precision, root.T @ (root @ sums.b), lower, upper)
        previous, active = active, X @ theta > 0
        entered, left = np.flatnonzero(active & ~previous), np.flatnonzero(previous & ~active)
        if len(entered) == len(left) == 0 or sums.n + len(entered) - len(left) <= len(theta):
            break
        sums = sums + Sums.of(X[entered], P[entered]) - Sums.of(X[left], P[left])
    return theta, sums


@dataclass(frozen=True)
class _Ellipsoid:
    """Ellipsoid of `ClippedGaussianTarget`, or the unbounded one.

    ``sure`` are the sums of the samples that are active throughout it; ``w`` (m, p), ``u`` (m,) and ``e`` (m,) are
    those of the m undecided samples.
    """

    sure: Sums
    w: Floats
    u: Floats
    e: Floats

    @cached_property
    def _residual(self) -> tuple[Floats, Floats, float]:
        """Rows (m, p + 1), floor (m, 1) and sum of e^2, with h - e = max(rows [z, 1], floor)."""
        rows = np.column_stack([self.w, np.minimum(self.u, 0.0) - self.e])
        return rows, -(np.maximum(self.u, 0.0) + self.e)[:, None], float(self.e @ self.e)

    def excess(self, z: Floats) -> Floats:
        """Chi2 less that of the centre (k,), for columns [z, 1] (p + 1, k) inside the ellipsoid."""
        total = self.sure.excess(z)
        if len(self.e):
            rows, floor, least = self._residual
            step, ones = max(BATCH // len(self.e), 1), np.ones(len(self.e))
            for i in range(0, z.shape[1], step):
                residual = rows @ z[:, i : i + step]
                np.maximum(residual, floor, out=residual)
                total[i : i + step] += ones @ np.square(residual, out=residual) - least
        return total

    def information(self, z: Floats) -> Floats:
        """Sum (p, p) of w w' over the samples active at [z, 1] (p + 1,)."""
        active = self.w[self.w @ z[:-1] + self.u > 0]
        return self.sure.G + active.T @ active


class ClippedGaussianTarget:
    """The paper's likelihood of samples, with a flat prior in a finite box.

    ``X`` (n, p) are the columns of `road_load.design`, ``P`` (n,) [W] the power, ``lower`` and ``upper`` (p,) the box.
    The paper re-estimates sigma^2 = chi2 / (n - p) along the chain. Here it is fixed at the least-squares point, to
    which the paper's value converges. The chain so has one invariant distribution from its first iteration on.
    """

    def __init__(self, X: Floats, P: Floats, lower: Floats, upper: Floats) -> None:
        self.lower, self.upper = lower, upper
        self.centre, sums = clipped_least_squares(X, P, lower, upper)
        u = X @ self.centre
        e = P - np.maximum(u, 0.0)
        finest = MIN_RESIDUAL_SHARE**2 * float(P @ P) / max(len(P), 1)
        self.variance = max(float(e @ e) / max(len(P) - len(lower), 1), finest, np.finfo(float).tiny)  # W^2
        sigma = self.variance**0.5
        wide = np.diag((upper - lower) ** -2.0)  # as wide as the box where the data do not determine a parameter
        self._whiten = factor(sums.G / self.variance + wide)  # z = whiten' (theta - centre)
        self._colour = np.linalg.inv(self._whiten).T  # L
        w = X @ (self._colour / sigma)
        self._endless = _Ellipsoid(Sums.empty(len(self.centre)), w, u / sigma, e / sigma)
        self._squared_radii = np.array(RADII) ** 2
        self._nest = _nest(self._endless)
        slope = X.T @ np.where(u > 0, e, 0.0) / self.variance
        beyond_data = wide + bound_precision(self.centre, slope, lower, upper)
        self._beyond_data = self._colour.T @ beyond_data @ self._colour

    def _ellipsoid(self, i: int) -> _Ellipsoid:
        return self._nest[i] if i < len(self._nest) else self._endless

    def _locate(self, theta: Floats) -> tuple[Floats, NDArray[np.int8]]:
        """Columns [z, 1] (p + 1, k) of ``theta`` (k, p), and the number (k,) of the innermost ellipsoid around each."""
        z = np.ones((theta.shape[1] + 1, len(theta)))
        np.matmul(self._whiten.T, theta.T - self.centre[:, None], out=z[:-1])
        squared = np.einsum("ij,ij->j", z[:-1], z[:-1])
        number = np.zeros(len(theta), dtype=np.int8)
        for limit in self._squared_radii:  # several times faster than a search for each
            number += squared > limit
        return z, number

    def log_density(self, theta: Floats) -> Floats:
        """Unnormalised log density (k,), see `Target.log_density`; zero at the centre."""
        z, number = self._locate(theta)
        number[~in_box(theta, self.lower, self.upper)] = -1
        density = np.full(len(theta), -np.inf)
        for i in range(len(self._nest) + 1):
            members = np.flatnonzero(number == i)
            if len(members):
                density[members] = -0.5 * self._ellipsoid(i).excess(z.take(members, axis=1))
        return density

    def curvature(self, theta: Floats) -> Floats:
        """Covariances (k, p, p) sigma^2 (J' J)^-1, with J the Jacobian of the clipped power, limited to the box."""
        z, number = self._locate(theta)
        information = np.stack([self._ellipsoid(i).information(column) for i, column in zip(number, z.T, strict=True)])
        covariance: Floats = self._colour @ np.linalg.inv(information + self._beyond_data) @ self._colour.T
        return covariance


def _nest(endless: _Ellipsoid) -> list[_Ellipsoid]:
    """Ellipsoids of RADII, the smallest first, from the unbounded one, in which all samples are undecided."""
    nest, sure, w, u, e = list[_Ellipsoid](), endless.sure, endless.w, endless.u, endless.e
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = np.abs(u) / np.sqrt(np.einsum("ij,ij->i", w, w))  # |z| where the sample can change sign first
    for radius in RADII[::-1]:
        decided = turn > radius
        active = np.flatnonzero(decided & (u > 0))
        sure = sure + Sums.of(w[active], e[active])
        rest = np.flatnonzero(~decided)
        w, u, e, turn = w[rest], u[rest], e[rest], turn[rest]
        nest.append(_Ellipsoid(sure, w, u, e))
    return nest[::-1]

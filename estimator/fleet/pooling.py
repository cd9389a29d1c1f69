"""Hierarchical model that pools estimates of several drives, which scatter by more than their sd.

Drive ``i`` has the true value theta_i ~ N(X_i mu, T), T = diag(tau_1^2, tau_2^2), and the estimate
z_i ~ N(theta_i, V_i). T includes wind, rain, tyres, and errors of the model that last for a drive. X_i are the terms of
`over_time`, and mu their coefficients, which the drives share. The prior of the value now is flat, those of trend and
season are normal, so everything but tau is Gaussian (Gelman et al., Bayesian Data Analysis, section 5.4). The scatter
tau has a half-t prior (Gelman 2006) and is summed over a grid, without sampling or a seed.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri

from estimator.estimates import Marginal
from estimator.fleet.over_time import NOW, PRIOR_SD, terms
from estimator.signals import Floats

NODES = 20  # of the grid of each tau
MAX_TAU_SCALES = 8.0  # largest node of each tau, in scales of its prior
DEGREES = 4.0  # of freedom of the prior
NEGLIGIBLE = 1e-8  # weight of a node, as a share of the largest


@dataclass(frozen=True)
class Mixture:
    """Mixture of normal distributions: ``weights`` (k,) that sum to 1, ``means`` (k,) and ``sds`` (k,)."""

    weights: Floats
    means: Floats
    sds: Floats

    def cdf(self, x: float) -> float:
        """Cumulative probability at ``x``."""
        return float(self.weights @ ndtr((x - self.means) / self.sds))

    def quantile(self, p: float) -> float:
        """Quantile for the probability ``p``; it lies between the smallest and largest one of the components."""
        quantiles = self.means + float(ndtri(p)) * self.sds
        low, high = float(quantiles.min()), float(quantiles.max())
        step = 1e-12 * max(abs(low), abs(high), 1e-300)
        if high - low <= step:
            return low
        return float(brentq(lambda x: self.cdf(x) - p, low - step, high + step, xtol=step))

    @property
    def moments(self) -> tuple[float, float]:
        """Mean and sd."""
        mean = float(self.weights @ self.means)
        return mean, float(self.weights @ (self.sds**2 + (self.means - mean) ** 2)) ** 0.5

    @property
    def marginal(self) -> Marginal:
        """Mean, sd, and quantiles of 5, 50 and 95 %."""
        mean, sd = self.moments
        q05, q50, q95 = (self.quantile(p) for p in (0.05, 0.5, 0.95))
        return Marginal(mean=mean, sd=sd, q05=q05, q50=q50, q95=q95)


@dataclass(frozen=True, kw_only=True)
class Pooled:
    """Posterior of mu and of each theta_i, as a mixture over K nodes of the grid of tau.

    ``weights`` (K,); ``tau`` (K, 2); ``mean`` (K, 2, q) and ``covariance`` (K, 2, q, 2, q) of mu, for q terms;
    ``drive_mean`` (K, n, 2) and ``drive_covariance`` (K, n, 2, 2) of theta.
    """

    weights: Floats
    tau: Floats
    mean: Floats
    covariance: Floats
    drive_mean: Floats
    drive_covariance: Floats

    def shared(self, i: int) -> Mixture:
        """Posterior of component ``i`` at the newest drive."""
        return self.combined(i, NOW)

    def combined(self, i: int, share: Floats) -> Mixture:
        """Posterior of the sum of the terms of component ``i``, weighted by ``share`` (q,)."""
        variance = np.einsum("q,kqr,r->k", share, self.covariance[:, i, :, i], share)
        return Mixture(self.weights, self.mean[:, i] @ share, np.sqrt(variance))

    def predicted(self, i: int) -> Mixture:
        """Predictive distribution of component ``i`` of theta on a future drive."""
        now = self.shared(i)
        return replace(now, sds=np.hypot(now.sds, self.tau[:, i]))

    def scatter(self, i: int) -> float:
        """Posterior root mean square of tau of component ``i``."""
        return float(np.sqrt(self.weights @ self.tau[:, i] ** 2))


def pool(z: Floats, V: Floats, scale: float, years: Floats) -> Pooled:
    """Estimate the coefficients that drives share.

    Parameters
    ----------
    z, V
        Estimates (n, 2) of positive quantities, and their covariances (n, 2, 2).
    scale
        Scale of the half-t prior of tau, as a share of the value.
    years
        Times of the drives (n,) [years] since the newest of them.
    """
    X = terms(years)
    centre = _weighted_mean(z, V, np.zeros(2))
    centre = _weighted_mean(z, V, (scale * centre) ** 2)
    steps = MAX_TAU_SCALES * np.linspace(0.0, 1.0, NODES) ** 2  # close where tau is small
    share = (1 + steps**2 / DEGREES) ** (-(DEGREES + 1) / 2) * np.gradient(steps)
    first, second = np.meshgrid(np.arange(NODES), np.arange(NODES), indexing="ij")
    nodes = np.column_stack([first.ravel(), second.ravel()])
    tau = scale * np.abs(centre) * steps[nodes]
    T = tau**2  # (K, 2), the diagonal
    W = _inverse(V + (T[:, :, None] * np.eye(2))[:, None])  # (K, n, 2, 2)
    believed = (PRIOR_SD * np.abs(centre)[:, None]) ** -2.0  # precision (2, q)
    products = np.tensordot(W, X[:, :, None] * X[:, None, :], axes=(1, 0))  # (K, 2, 2, q, q)
    information = np.swapaxes(products, 2, 3).reshape(len(W), believed.size, -1) + np.diag(believed.ravel())
    P = np.linalg.inv(information)
    moment = np.tensordot(np.einsum("knij,nj->nki", W, z), X, axes=(0, 0)).reshape(len(W), -1)
    mean = np.einsum("kij,kj->ki", P, moment).reshape(-1, *believed.shape)
    left = z - np.swapaxes(mean @ X.T, 1, 2)  # (K, n, 2)
    pulled = np.einsum("knij,knj->kni", W, left)
    misfit = (left * pulled).sum(axis=(1, 2)) + (mean**2 * believed).sum(axis=(1, 2))
    log_weight = 0.5 * (np.log(_determinant(W)).sum(axis=1) - np.linalg.slogdet(information)[1] - misfit)
    weights = np.exp(log_weight - log_weight.max()) * share[nodes].prod(axis=1)
    used = weights > NEGLIGIBLE * weights.max()
    weights, tau, T, W, P = (array[used] for array in (weights, tau, T, W, P))
    mean, left, pulled = (array[used] for array in (mean, left, pulled))
    # theta_i given mu is N(X mu + T W (z - X mu), (1 - T W) T).
    rest = np.eye(2) - T[:, None, :, None] * W
    P = P.reshape(-1, *believed.shape, *believed.shape)
    there = np.einsum("nq,kiqjr,nr->knij", X, P, X, optimize=True)
    return Pooled(
        weights=weights / weights.sum(),
        tau=tau,
        mean=mean,
        covariance=P,
        drive_mean=z - left + T[:, None] * pulled,
        drive_covariance=rest * T[:, None, None, :] + rest @ there @ np.swapaxes(rest, 2, 3),
    )


def _weighted_mean(z: Floats, V: Floats, scatter: Floats) -> Floats:
    W = _inverse(V + np.diag(scatter))
    mean: Floats = np.linalg.solve(W.sum(axis=0), np.einsum("nij,nj->i", W, z))
    return mean


def _determinant(a: Floats) -> Floats:
    determinant: Floats = a[..., 0, 0] * a[..., 1, 1] - a[..., 0, 1] * a[..., 1, 0]
    return determinant


def _inverse(a: Floats) -> Floats:
    """Inverse of symmetric matrices (..., 2, 2)."""
    swapped = np.empty_like(a)
    swapped[..., 0, 0], swapped[..., 1, 1] = a[..., 1, 1], a[..., 0, 0]
    swapped[..., 0, 1], swapped[..., 1, 0] = -a[..., 0, 1], -a[..., 1, 0]
    inverse: Floats = swapped / _determinant(a)[..., None, None]
    return inverse

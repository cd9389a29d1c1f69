"""A hierarchical model of estimates that were printed per run: between-run and between-cycle spread, common mean.

Estimate y_ci (p,) of run i of cycle c, with hyperparameters kappa_c, tau, beta (p,) and common mean mu (p,):

    y_ci    ~ N(theta_c, kappa_c^2 S_ci + tau^2 d_c d_c' + F)
    theta_c ~ N(mu, diag(beta^2))

S_ci is the covariance that white power noise of the run's own rms gives, so kappa_c = 1 says that the scatter between
runs is that noise. d_c is the change of the estimates for a constant error of the measured power, so tau is the sd
between runs of the zero of the power measurement. F is the variance of rounding to the printed digits. beta is the
spread between cycles. Priors: log kappa_c ~ N(0, 1); tau and beta half-normal; mu flat.

Given the hyperparameters everything is Gaussian, so theta and mu are integrated in closed form; the hyperparameters
are sampled, and theta and mu are then drawn from their conditional distributions. Gelman, Carlin, Stern, Dunson,
Vehtari, Rubin, "Bayesian Data Analysis", 3rd edition, section 5.4.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.optimize import minimize
from scipy.special import ndtr, ndtri

from estimator.sampling.likelihood import factor, in_box
from estimator.sampling.run import run
from estimator.signals import Floats

CHAINS, BURN_IN, DRAWS = 16, 1_000, 5_000
HESSIAN_STEP = 1e-2  # of the scores
BOX = 6.0  # largest score: 2e-9 of the prior is outside
BATCH = 4096  # hyperparameters evaluated at once


@dataclass(frozen=True, kw_only=True)
class CycleRuns:
    """Estimates ``y`` (n, p) of the runs of one cycle.

    ``noise`` (n, p, p): covariances S_ci of white noise. ``offset`` (p,): d_c, per unit of tau. ``rounding`` (p, p): F.
    """

    y: Floats
    noise: Floats
    offset: Floats
    rounding: Floats


@dataclass(frozen=True, kw_only=True)
class Prior:
    """Scales of the half-normal priors: ``tau``, and ``beta`` (p,) in the unit of each parameter."""

    tau: float
    beta: Floats


@dataclass(frozen=True, kw_only=True)
class Conditional:
    """Gaussians given k hyperparameters: ``log_marginal`` (k,) of the estimates, and the means.

    ``mean`` (k, p) and ``precision`` (k, p, p) of mu; ``cycle_mean`` (k, c, p) and ``cycle_covariance`` (k, c, p, p)
    of the likelihood of each theta_c.
    """

    log_marginal: Floats
    mean: Floats
    precision: Floats
    cycle_mean: Floats
    cycle_covariance: Floats


def conditional(cycles: Sequence[CycleRuns], kappa: Floats, tau: Floats, beta: Floats) -> Conditional:
    """Integrate theta and mu for hyperparameters ``kappa`` (k, c), ``tau`` (k,) and ``beta`` (k, p)."""
    k, p = beta.shape
    between = beta[:, :, None] * np.eye(p) * beta[:, None, :]
    log_marginal = np.zeros(k)
    means, covariances, weights = [], [], []
    for c, cycle in enumerate(cycles):
        excess = tau[:, None, None] ** 2 * np.outer(cycle.offset, cycle.offset) + cycle.rounding
        covariance = kappa[:, c, None, None, None] ** 2 * cycle.noise + excess[:, None]
        precision = np.linalg.inv(covariance)
        total = np.linalg.inv(precision.sum(axis=1))
        mean = np.einsum("kij,knjl,nl->ki", total, precision, cycle.y)
        residual = cycle.y - mean[:, None]
        weight = np.linalg.inv(total + between)
        log_marginal -= 0.5 * np.einsum("kni,knij,knj->k", residual, precision, residual)
        log_marginal -= 0.5 * (_log_det(covariance).sum(axis=1) - _log_det(total) - _log_det(weight))
        means.append(mean)
        covariances.append(total)
        weights.append(weight)
    y, W = np.stack(means, axis=1), np.stack(weights, axis=1)
    precision = W.sum(axis=1)
    mu = np.einsum("kij,kcjl,kcl->ki", np.linalg.inv(precision), W, y)
    away = y - mu[:, None]
    log_marginal -= 0.5 * (np.einsum("kci,kcij,kcj->k", away, W, away) + _log_det(precision))
    return Conditional(
        log_marginal=log_marginal,
        mean=mu,
        precision=precision,
        cycle_mean=y,
        cycle_covariance=np.stack(covariances, axis=1),
    )


def _log_det(matrix: Floats) -> Floats:
    logarithm: Floats = np.linalg.slogdet(matrix)[1]
    return logarithm


@dataclass(frozen=True)
class HyperparameterTarget:
    """Posterior of the scores x of [kappa (c,), tau, beta (p,)], theta and mu integrated; a `likelihood.Target`.

    The scores have a standard normal prior: log kappa = x, and tau and beta are the quantiles of their half-normal
    priors at the probability of x.
    """

    cycles: Sequence[CycleRuns]
    prior: Prior

    @property
    def size(self) -> int:
        """Number of hyperparameters."""
        return len(self.cycles) + 1 + len(self.prior.beta)

    @property
    def lower(self) -> Floats:
        """See `Target.lower`."""
        return np.full(self.size, -BOX)

    @property
    def upper(self) -> Floats:
        """See `Target.upper`."""
        return np.full(self.size, BOX)

    @cached_property
    def _mode(self) -> tuple[Floats, Floats]:
        def loss(x: Floats) -> float:
            return -float(self.log_density(x[None])[0])

        mode: Floats = minimize(loss, np.zeros(self.size), method="BFGS").x
        steps = HESSIAN_STEP * np.eye(len(mode))
        plus, minus = steps[:, None] + steps, steps[:, None] - steps
        shifted = mode + np.stack([plus, -plus, minus, -minus]).reshape(-1, len(mode))
        a, b, c, d = self.log_density(shifted).reshape(4, len(mode), len(mode))
        return mode, np.linalg.inv((c + d - a - b) / (4 * HESSIAN_STEP**2))

    @property
    def centre(self) -> Floats:
        """See `Target.centre`."""
        return self._mode[0]

    def curvature(self, theta: Floats) -> Floats:
        """See `Target.curvature`; the inverse Hessian at the mode, everywhere."""
        return np.broadcast_to(self._mode[1], (len(theta), *self._mode[1].shape))

    def split(self, scores: Floats) -> tuple[Floats, Floats, Floats]:
        """Hyperparameters kappa (k, c), tau (k,) and beta (k, p) of their ``scores`` (k, c + 1 + p)."""
        c = len(self.cycles)
        half_normal = ndtri(0.5 + 0.5 * ndtr(scores[:, c:]))
        return np.exp(scores[:, :c]), self.prior.tau * half_normal[:, 0], self.prior.beta * half_normal[:, 1:]

    def log_density(self, theta: Floats) -> Floats:
        """See `Target.log_density`."""
        density = np.full(len(theta), -np.inf)
        inside = np.flatnonzero(in_box(theta, self.lower, self.upper))
        for start in range(0, len(inside), BATCH):
            batch = inside[start : start + BATCH]
            scores = theta[batch]
            prior = -0.5 * np.einsum("ki,ki->k", scores, scores)
            density[batch] = prior + conditional(self.cycles, *self.split(scores)).log_marginal
        return density


@dataclass(frozen=True, kw_only=True)
class HierarchicalFit:
    """Posterior draws: ``kappa`` (n, c), ``tau`` (n,), ``beta`` (n, p), ``mu`` (n, p) and ``theta`` (n, c, p)."""

    kappa: Floats
    tau: Floats
    beta: Floats
    mu: Floats
    theta: Floats
    r_hat: float


def fit(cycles: Sequence[CycleRuns], prior: Prior, rng: np.random.Generator) -> HierarchicalFit:
    """Sample the hyperparameters with the program's random walk, then mu and theta from their conditionals."""
    target = HyperparameterTarget(cycles, prior)
    result = run(target, "random_walk", CHAINS, BURN_IN, DRAWS, rng)
    kappa, tau, beta = target.split(result.draws.reshape(-1, result.draws.shape[2]))
    given = conditional(cycles, kappa, tau, beta)
    mu = given.mean + _gaussian(np.linalg.inv(given.precision), rng)
    between = beta[:, None, :, None] * np.eye(beta.shape[1]) * beta[:, None, None, :]
    gain = between @ np.linalg.inv(between + given.cycle_covariance)
    theta = mu[:, None] + np.einsum("kcij,kcj->kci", gain, given.cycle_mean - mu[:, None])
    theta += _gaussian(between - gain @ between, rng)
    return HierarchicalFit(
        kappa=kappa,
        tau=tau,
        beta=beta,
        mu=mu,
        theta=theta,
        r_hat=max(diagnosis.r_hat for diagnosis in result.diagnoses),
    )


def _gaussian(covariance: Floats, rng: np.random.Generator) -> Floats:
    """One draw (..., p) of each N(0, covariance (..., p, p))."""
    symmetric = 0.5 * (covariance + np.swapaxes(covariance, -1, -2))
    draws: Floats = np.einsum("...ij,...j->...i", factor(symmetric), rng.standard_normal(symmetric.shape[:-1]))
    return draws

"""Evidence of a column of power on a drive, from moments of instruments, so that noise of the column is no evidence.

Base model P = X theta + e with instruments Z. A candidate adds the column h with instrument z and magnitude b. With
both projected off the base,

    z~ = z - Z (X'Z)^-1 X'z,    h~ = h - X (Z'X)^-1 Z'h,    b^ = z~'P / z~'h

is the instrumental-variable estimate of b with A, C, m and the lag refitted. Its variance is the long-run variance of
z~ (e - h~ b^), Student distributed with the degrees of freedom of that variance. The Bayes factor against b = 0 is
the likelihood averaged over the prior of b, divided by the likelihood at 0.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from estimator.estimation.moments import autocorrelation_time, long_run_covariance
from estimator.signals import Floats

Blocks = NDArray[np.int64]

BLOCK = 5.0  # s of samples whose moments are summed before their covariance is taken
MIN_COSINES = 16  # degrees of freedom of a long-run variance
TIMES_PER_COSINE = 3.0  # autocorrelation times that one cosine transform must span
GRID_POINTS = 161  # of the grid over a magnitude
GRID_SDS = 6.0  # sd of the prior, and of the likelihood, that the grid spans
MIN_DOF = 4.0  # of the Student density: below, its variance is hardly defined
MAX_CONDITION = 1e7  # condition number of the base's equations, columns scaled to one
MIN_EXPLAINED_SHARE = 1e-4  # |correlation| of instrument and column below which the magnitude is not estimated


@dataclass(frozen=True, kw_only=True)
class Base:
    """The fitted base model: columns ``X``, instruments ``Z`` (n, p), power ``P`` (n,) [W], block of each sample."""

    X: Floats
    Z: Floats
    P: Floats
    block: Blocks
    theta: Floats
    inverse: Floats  # (Z'X)^-1

    @property
    def residual(self) -> Floats:
        """Measured power less that of the model [W] (n,)."""
        return self.P - self.X @ self.theta


def fit_base(X: Floats, Z: Floats, P: Floats, block: Blocks) -> Base | None:
    """Instrumental-variable fit of ``P`` (n,) on ``X`` by ``Z`` (n, p); None where columns are not independent."""
    scale = np.sqrt(np.mean(X**2, axis=0))
    if not np.all(scale > 0):
        return None
    scaled = (Z / scale).T @ (X / scale) / len(X)
    if np.linalg.cond(scaled) > MAX_CONDITION:
        return None
    inverse = np.linalg.inv(scaled) / np.outer(scale, scale) / len(X)
    return Base(X=X, Z=Z, P=P, block=block, theta=inverse @ (Z.T @ P), inverse=inverse)


@dataclass(frozen=True)
class Score:
    """Estimates of k magnitudes, each alone on top of the base: value, sd, degrees of freedom; all arrays (k,)."""

    value: Floats
    sd: Floats
    dof: Floats

    @property
    def t(self) -> Floats:
        """Value in standard deviations (k,)."""
        return self.value / self.sd


def score(base: Base, h: Floats, z: Floats) -> Score:
    """Estimate the magnitude of each column of ``h`` (n, k) with instruments ``z`` (n, k)."""
    outer = z - base.Z @ (base.inverse.T @ (base.X.T @ z))
    inner = h - base.X @ (base.inverse @ (base.Z.T @ h))
    strength = (outer * h).sum(axis=0)
    weak = np.abs(strength) <= MIN_EXPLAINED_SHARE * np.sqrt((z**2).sum(axis=0) * (h**2).sum(axis=0))
    strength = np.where(weak, np.nan, strength)
    residual = base.residual
    value = outer.T @ residual / strength
    left = residual[:, None] - inner * np.nan_to_num(value)
    moments = block_sums(outer * left, base.block)
    variance, dof = long_run_variance(moments)
    lost = max(1.0 - (base.X.shape[1] + 1) / len(moments), 0.5)
    return Score(value, np.sqrt(variance / lost) / np.abs(strength), dof)


def parameter_sd(base: Base, i: int) -> float:
    """Standard deviation of the base model's parameter ``i``; the residual may be autocorrelated."""
    influence = (base.Z * base.residual[:, None]) @ base.inverse[i]
    variance, dof = long_run_variance(block_sums(influence[:, None], base.block))
    # The fit uses up one degree of freedom for each parameter; the estimate is Student distributed.
    left = max(float(dof[0]) - base.X.shape[1], MIN_DOF)
    return float(np.sqrt(variance[0] * dof[0] / left * left / (left - 2.0)))


def block_sums(values: Floats, block: Blocks) -> Floats:
    """Sums (blocks, k) of ``values`` (n, k) over each block, in order."""
    starts = np.flatnonzero(np.diff(block, prepend=block[0] - 1))
    return np.add.reduceat(values, starts, axis=0)


def blocks_of(t: Floats) -> Blocks:
    """Number of the block of BLOCK [s] that each time falls into (n,)."""
    number: Blocks = np.floor((t - t[0]) / BLOCK).astype(np.int64)
    return number


def long_run_variance(moments: Floats) -> tuple[Floats, Floats]:
    """Variance (k,) of the column sums of autocorrelated ``moments`` (n, k), and its degrees of freedom (k,)."""
    n, k = moments.shape
    variance, dof = np.empty(k), np.empty(k)
    for i in range(k):
        time = autocorrelation_time(moments[:, i])
        count = int(np.clip(n / (TIMES_PER_COSINE * time), MIN_COSINES, max(0.6 * n ** (5 / 6), MIN_COSINES)))
        count = min(count, n // 2)
        variance[i], dof[i] = long_run_covariance(moments[:, [i]], count)[0, 0], count
    return variance, dof


def log_bayes_factor(score: Score, usual: float, positive: bool) -> Floats:
    """Log Bayes factor (k,) of each magnitude against none; its prior is Gaussian with sd ``usual``, or half of one."""
    low, high = 0.0 if positive else -GRID_SDS * usual, GRID_SDS * usual
    steps = np.linspace(-1.0, 1.0, GRID_POINTS)[:, None]
    everywhere = (low + high) / 2 + (high - low) / 2 * steps
    near = score.value + GRID_SDS * score.sd * np.sinh(3 * steps) / np.sinh(3)
    b = np.sort(np.concatenate([np.broadcast_to(everywhere, near.shape), np.clip(near, low, high)]), axis=0)
    t = (b - score.value) / score.sd
    against = -0.5 * (score.dof + 1) * (np.log1p(t**2 / score.dof) - np.log1p(score.t**2 / score.dof))
    density = against - 0.5 * (b / usual) ** 2 - np.log(usual * np.sqrt(2 * np.pi) / (2 if positive else 1))
    middle, width = (density[1:] + density[:-1]) / 2, np.diff(b, axis=0)
    return np.asarray(logsumexp(middle, b=width, axis=0))

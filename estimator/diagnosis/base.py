"""The plain fit of a drive's power, by instruments, so that noise of a column does not bias it.

Model P = X theta + e with instruments Z: theta = (Z'X)^-1 Z'P. Its covariance is the long-run one of the moments Z e.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.moments import autocorrelation_time, long_run_covariance
from estimator.signals import Floats

Blocks = NDArray[np.int64]

BLOCK = 5.0  # s of samples whose moments are summed before their covariance is taken
MIN_COSINES = 16  # degrees of freedom of a long-run variance
TIMES_PER_COSINE = 3.0  # autocorrelation times that one cosine transform must span
MIN_DOF = 4.0  # of the Student density: below, its variance is hardly defined
MAX_CONDITION = 1e7  # condition number of the base's equations, columns scaled to one


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


def parameter_sd(base: Base, i: int) -> float:
    """Standard deviation of the base model's parameter ``i``; the residual may be autocorrelated."""
    influence = (base.Z * base.residual[:, None]) @ base.inverse[i]
    variance, dof = long_run_variance(block_sums(influence[:, None], base.block))
    # The fit uses up one degree of freedom for each parameter (dof / left), and the estimate is Student distributed
    # (left / (left - 2)).
    left = max(float(dof[0]) - base.X.shape[1], MIN_DOF)
    return float(np.sqrt(variance[0] * dof[0] / (left - 2.0)))


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

"""Residuals on stretches of the drive that were left out of the fit, with and without effects.

Residuals are averaged over 2 s. Faster changes are noise of dv/dt, which no effect reduces.
"""

from dataclasses import dataclass

import numpy as np

from estimator.diagnosis.model import BLOCK_SAMPLES
from estimator.diagnosis.result import GapClosed
from estimator.estimation.moments import block_means
from estimator.model.design_matrix import PLAIN, Term, columns
from estimator.samples import Samples
from estimator.signals import Floats

FOLDS = 10
STRETCHES_PER_FOLD = 3  # stretches of each fold
BOOTSTRAP_BLOCK = 30  # residuals of 2 s, 1 min, that the bootstrap draws together
RESAMPLES = 400  # of the bootstrap: the ends of a 90 % interval vary by about 3 % of its width


@dataclass(frozen=True)
class HeldOut:
    """Squared residuals [W^2] (n,) of 2 s each, on stretches not used for the fit."""

    squares: Floats

    @property
    def mean_square(self) -> float:
        """[W^2]."""
        return float(self.squares.mean())

    @property
    def rms(self) -> float:
        """[W]."""
        return float(np.sqrt(self.mean_square))


def held_out(samples: Samples, terms: tuple[Term, ...], road_load: Floats, lagged: bool = True) -> HeldOut:
    """Residuals of the model with ``terms``, each from a fit to the other folds; without the lag if not ``lagged``.

    ``road_load`` = [A, C, m] (3,) scales the terms.
    """
    X, Z = columns(samples, terms, road_load)
    if not lagged:
        X, Z = np.delete(X, PLAIN - 1, axis=1), np.delete(Z, PLAIN - 1, axis=1)
    P = samples.P
    fold = (np.arange(len(P)) * FOLDS * STRETCHES_PER_FOLD // len(P)) % FOLDS
    cross = np.stack([Z[fold == k].T @ X[fold == k] for k in range(FOLDS)])
    moment = np.stack([Z[fold == k].T @ P[fold == k] for k in range(FOLDS)])
    residual = np.empty(len(P))
    for k in range(FOLDS):
        theta = np.linalg.lstsq(cross.sum(axis=0) - cross[k], moment.sum(axis=0) - moment[k], rcond=None)[0]
        residual[fold == k] = P[fold == k] - X[fold == k] @ theta
    return HeldOut(block_means(residual, BLOCK_SAMPLES) ** 2)


def gap_closed(before: HeldOut, after: HeldOut, floor: float, doubt: float, rng: np.random.Generator) -> GapClosed:
    """Share of what lies above the ``floor`` [W^2] that is gone, with a block-bootstrap interval.

    ``doubt`` is the share of the floor that may be an effect instead of noise.
    """
    n = len(before.squares) // BOOTSTRAP_BLOCK
    if n < 2:
        return GapClosed(float("nan"), float("nan"), float("nan"))
    pairs = np.column_stack([block_means(x.squares, BOOTSTRAP_BLOCK) for x in (before, after)])
    draws = pairs[rng.integers(0, n, (RESAMPLES, n))].mean(axis=1)
    # The floor of a resample scales with its residual: both are of the same stretches.
    floors = floor * draws[:, 1] / after.mean_square * (1 - doubt * rng.standard_normal(RESAMPLES).clip(0, 1))
    shares = np.array([_share(b, a, f) for (b, a), f in zip(draws, floors, strict=True)])
    q05, q95 = np.quantile(shares, [0.05, 0.95]).tolist()
    return GapClosed(_share(before.mean_square, after.mean_square, floor), q05, q95)


def _share(before: float, after: float, floor: float) -> float:
    if before <= floor:
        return 0.0
    return float(np.clip(1 - (after - floor) / (before - floor), -1.0, 1.0))

"""Divide a record into folds, for residuals on stretches that are left out of a fit."""

from collections.abc import Iterator

import numpy as np

from estimator.signals import Mask

SEED = 20_044  # of the random order
FOLDS, STRETCHES = 5, 20  # of a record, for cross-validation


def left_out(n: int, folds: int, length: int) -> Iterator[Mask]:
    """Mask (n,) of the rows that each of ``folds`` leaves out: in every round of ``folds`` stretches, one of each fold.

    A stretch has ``length`` rows. The order is random in every round. With a fixed order, a fan that switches with the
    same period would act in the stretches of one fold only, and no other fold would show its size.
    """
    stretch = np.arange(n) // max(length, 1)
    rounds = np.tile(np.arange(folds), (n // (folds * max(length, 1)) + 1, 1))
    turn = np.random.default_rng(SEED).permuted(rounds, axis=1).ravel()[stretch]
    for k in range(folds):
        yield turn == k


def cross_validation(n: int) -> Iterator[Mask]:
    """Masks (n,) of the rows that each of FOLDS leaves out, in STRETCHES of equal length."""
    return left_out(n, FOLDS, n // STRETCHES)

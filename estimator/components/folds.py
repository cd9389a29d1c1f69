"""Folds of a record for a residual on stretches left out of a fit."""

from collections.abc import Iterator

import numpy as np

from estimator.signals import Mask

SEED = 20_044  # of the order in every round


def left_out(n: int, folds: int, length: int) -> Iterator[Mask]:
    """Which of ``n`` rows (n,) each of the ``folds`` leaves out: stretches of ``length`` rows, one each in a round.

    Every round has an order of its own: at equal distances a fan that switches with their period would act in the
    stretches of one fold alone, and none of the others would show its size.
    """
    stretch = np.arange(n) // max(length, 1)
    rounds = np.tile(np.arange(folds), (n // (folds * max(length, 1)) + 1, 1))
    turn = np.random.default_rng(SEED).permuted(rounds, axis=1).ravel()[stretch]
    for k in range(folds):
        yield turn == k

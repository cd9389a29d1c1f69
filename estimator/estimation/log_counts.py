"""Counts of positive values by their logarithm: quantiles of any number of them, in bounded memory."""

from typing import Any

import numpy as np

from estimator.checkpoint.validation import State, array
from estimator.errors import StateError
from estimator.signals import Floats

WIDTH = 0.02  # of a bin, in the logarithm: 2 %
LOWEST, HIGHEST = -7.0, 9.0  # logarithms that are told apart: 1e-3 to 8e3
BINS = round((HIGHEST - LOWEST) / WIDTH)


class LogCounts:
    """Counts in bins of WIDTH; what lies beyond the ends is counted in the outermost bins."""

    def __init__(self) -> None:
        self._counts = np.zeros(BINS)

    def add(self, values: Floats) -> None:
        """Take positive values (n,); others, and those not known, are left out."""
        positive = values[np.isfinite(values) & (values > 0)]
        bins = np.clip((np.log(positive) - LOWEST) / WIDTH, 0, BINS - 1).astype(np.int64)
        self._counts += np.bincount(bins, minlength=BINS)

    def __len__(self) -> int:
        return int(self._counts.sum())

    def quantile(self, share: float) -> float:
        """Value that this share of them is below; there must be some."""
        below = np.cumsum(self._counts)
        place = int(np.searchsorted(below, share * below[-1]))
        return float(np.exp(LOWEST + (min(place, BINS - 1) + 0.5) * WIDTH))

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads."""
        return {"counts": self._counts.copy()}

    def restore(self, state: State) -> None:
        """Take the state of other counts.

        Raises
        ------
        StateError
            The state is not that of counts.
        """
        counts = array(state, "counts", (BINS,))
        if np.any(counts < 0):
            raise StateError("counts: are below zero")
        self._counts = counts

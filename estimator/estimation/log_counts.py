"""Histogram of positive values by their logarithm: quantiles of any number of values in bounded memory."""

from typing import Any

import numpy as np

from estimator.checkpoint.validation import State, array
from estimator.errors import StateError
from estimator.signals import Floats

WIDTH = 0.02  # width of a bin in the natural logarithm: 2 %
LOWEST, HIGHEST = -7.0, 9.0  # range of the logarithm: values from 1e-3 to 8e3
BINS = round((HIGHEST - LOWEST) / WIDTH)


class LogCounts:
    """Counts in bins of WIDTH; values beyond the range are counted in the outermost bins."""

    def __init__(self) -> None:
        self._counts = np.zeros(BINS)

    def add(self, values: Floats) -> None:
        """Count the finite positive values (n,); others are ignored."""
        positive = values[np.isfinite(values) & (values > 0)]
        bins = np.clip((np.log(positive) - LOWEST) / WIDTH, 0, BINS - 1).astype(np.int64)
        self._counts += np.bincount(bins, minlength=BINS)

    def __len__(self) -> int:
        return int(self._counts.sum())

    def quantile(self, share: float) -> float:
        """Return the quantile at probability ``share``; at least one value must have been counted."""
        below = np.cumsum(self._counts)
        place = int(np.searchsorted(below, share * below[-1]))
        return float(np.exp(LOWEST + (min(place, BINS - 1) + 0.5) * WIDTH))

    def state(self) -> dict[str, Any]:
        """Return the state that `restore` reads."""
        return {"counts": self._counts.copy()}

    def restore(self, state: State) -> None:
        """Load the state of another histogram.

        Raises
        ------
        StateError
            The state does not belong to a histogram.
        """
        counts = array(state, "counts", (BINS,))
        if np.any(counts < 0):
            raise StateError("counts: are below zero")
        self._counts = counts

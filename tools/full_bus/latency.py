"""Quantiles of a stream of delays in constant memory."""

import numpy as np
from numpy.typing import ArrayLike

LOWEST, HIGHEST, PER_DECADE = -6, 2, 40  # decades of seconds; bins are 6 % wide


class Delays:
    """A histogram over the logarithm of time; the largest is kept exactly."""

    def __init__(self) -> None:
        self._edges = np.logspace(LOWEST, HIGHEST, (HIGHEST - LOWEST) * PER_DECADE + 1)
        self._counts = np.zeros(len(self._edges) + 1, np.int64)
        self._longest = 0.0

    def add(self, delays: ArrayLike) -> None:
        """Add delays (n,) [s]."""
        values = np.asarray(delays, dtype=float)
        if len(values):
            np.add.at(self._counts, np.searchsorted(self._edges, values), 1)
            self._longest = max(self._longest, float(values.max()))

    def summary(self) -> dict[str, float]:
        """Median, 99 % quantile and largest delay [ms]."""
        reached = np.cumsum(self._counts)

        def quantile(share: float) -> float:
            return 1e3 * min(
                self._longest, float(np.append(self._edges, np.inf)[np.searchsorted(reached, share * reached[-1])])
            )

        return {"p50_ms": quantile(0.5), "p99_ms": quantile(0.99), "max_ms": 1e3 * self._longest}

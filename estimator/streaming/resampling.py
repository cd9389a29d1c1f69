"""Readings that come at their senders' own times, resampled: held, or as means of the straight lines between them.

Nothing is held or bridged for longer than FRESH_PERIODS times the usual interval between readings: what is missing is
NaN.
"""

import numpy as np

from estimator.signals import Floats, Mask, Series

FRESH_PERIODS = 3.0  # sender periods after which a reading is stale
MIN_FRESH = 0.3  # s, for senders whose rate follows the engine speed
MAX_FRESH = 15.0  # s, for slow senders, and until the period of a sender is known


class Track:
    """Recent readings of one signal, and the time for which one of them is valid."""

    def __init__(self) -> None:
        self.t = np.empty(0)
        self.value = np.empty(0)
        self.fresh = np.nan

    def add(self, series: Series) -> None:
        """Add the readings later than all before them; a repeated time or a step back is dropped."""
        later = series.t > (self.t[-1] if len(self.t) else -np.inf)
        t, value = series.t[later], series.value[later]
        ascending = np.concatenate([[True], t[1:] > np.maximum.accumulate(t)[:-1]]) if len(t) else later[:0]
        self.t = np.concatenate([self.t, t[ascending]])
        self.value = np.concatenate([self.value, value[ascending]])
        if np.isnan(self.fresh) and len(self.t) > 4:
            period = float(np.median(np.diff(self.t)))
            self.fresh = min(max(FRESH_PERIODS * period, MIN_FRESH), MAX_FRESH)

    @property
    def limit(self) -> float:
        """How long [s] a reading counts."""
        return MAX_FRESH if np.isnan(self.fresh) else self.fresh

    def drop(self, wrong: Mask) -> None:
        """Remove readings (n,)."""
        self.t, self.value = self.t[~wrong], self.value[~wrong]

    def forget(self, before: float) -> None:
        """Drop what is older than ``before`` [s]."""
        # One reading before the horizon stays: it is the one that is held.
        first = max(int(np.searchsorted(self.t, before)) - 1, 0)
        self.t, self.value = self.t[first:], self.value[first:]

    def time_of_held(self, at: Floats) -> Floats:
        """Time [s] (n,) of the last reading at or before each of the times ``at`` (n,) [s], NaN where there is none."""
        last = np.searchsorted(self.t, at, side="right") - 1
        return np.where(last >= 0, self.t[np.maximum(last, 0)], np.nan) if len(self.t) else np.full(len(at), np.nan)

    def held(self, at: Floats, limit: float | None = None) -> Floats:
        """The last reading (n,) at or before each of the times ``at`` (n,) [s], NaN once it is stale."""
        if not len(self.t):
            return np.full(len(at), np.nan)
        last = np.searchsorted(self.t, at, side="right") - 1
        age = at - self.t[last]
        limit = self.limit if limit is None else limit
        return np.where((last >= 0) & (age <= limit), self.value[np.maximum(last, 0)], np.nan)

    def means(self, edges: Floats) -> tuple[Floats, Mask]:
        """`cell_means` (n,) of these readings between ``edges`` (n + 1,) [s]."""
        return cell_means(self.t, self.value, edges, self.limit)


def cell_means(t: Floats, value: Floats, edges: Floats, limit: float) -> tuple[Floats, Mask]:
    """Mean over each cell between ``edges`` (n + 1,) of the straight lines through readings.

    NaN in a cell that a line longer than ``limit`` [s], or one from a NaN reading, passes through; the second array
    says in which cells no such long line passes, that is, where there are readings.
    """
    n = len(edges) - 1
    if len(t) < 2:
        return np.full(n, np.nan), np.zeros(n, dtype=bool)
    width = np.diff(t)
    bad = ~np.isfinite(value)
    known = np.where(bad, 0.0, value)
    area = np.concatenate([[0.0], np.cumsum((known[1:] + known[:-1]) / 2 * width)])
    segment = np.clip(np.searchsorted(t, edges, side="right") - 1, 0, len(t) - 2)
    inside = edges - t[segment]
    slope = (known[segment + 1] - known[segment]) / width[segment]
    integral = area[segment] + inside * (known[segment] + slope * inside / 2)
    mean = np.diff(integral) / np.diff(edges)

    def touched(flag: Mask) -> Mask:
        count = np.concatenate([[0], np.cumsum(flag)])
        return count[segment[1:] + 1] > count[segment[:-1]]

    there = ~touched(width > limit) & (edges[:-1] >= t[0]) & (edges[1:] <= t[-1])
    return np.where(there & ~touched(bad[1:] | bad[:-1]), mean, np.nan), there

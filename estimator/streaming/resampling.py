"""Readings that come at their senders' own times, resampled: held, or as means of the straight lines between them.

Nothing is held or bridged for longer than FRESH_PERIODS times the usual interval between readings: what is missing is
NaN.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.signals import Floats, Mask, Series

FRESH_PERIODS = 3.0  # sender periods after which a reading is stale
MIN_FRESH = 0.3  # s, for senders whose rate follows the engine speed
MAX_FRESH = 15.0  # s, for slow senders, and until the period of a sender is known
MIN_READINGS_FOR_PERIOD = 5
SLOW_PERIOD = 0.2  # s: readings that are further apart are polled, and no neighbour can contradict a lone one


class Track:
    """Recent readings of one signal, and the time for which one of them is valid.

    They are kept for ``memory`` [s] longer than is asked for in `forget`.
    """

    def __init__(self, memory: float = 0.0) -> None:
        self._memory = memory
        self.t: Floats = np.empty(0)
        self.value: Floats = np.empty(0)
        self.fresh = np.nan

    def add(self, series: Series) -> int:
        """Add the readings later than all before them; returns how many were not: a repeated time or a step back."""
        before = len(self.t)
        self.t, self.value = self.joined(series)
        dropped = len(series.t) - (len(self.t) - before)
        if np.isnan(self.fresh) and len(self.t) >= MIN_READINGS_FOR_PERIOD:
            period = float(np.median(np.diff(self.t)))
            self.fresh = min(max(FRESH_PERIODS * period, MIN_FRESH), MAX_FRESH)
        return dropped

    def joined(self, series: Series) -> tuple[Floats, Floats]:
        """Times [s] and values after `add`."""
        later = series.t > (self.t[-1] if len(self.t) else -np.inf)
        t, value = series.t[later], series.value[later]
        ascending = np.concatenate([[True], t[1:] > np.maximum.accumulate(t)[:-1]]) if len(t) else later[:0]
        return np.concatenate([self.t, t[ascending]]), np.concatenate([self.value, value[ascending]])

    def is_settled(self, series: Series, ends: Floats, forgotten: Floats) -> bool:
        """Whether the period of the sender is known, or will not be known within some blocks.

        They end at ``ends`` (k,) [s]; what is older than ``forgotten`` (k,) [s] is dropped after each.
        """
        return bool(np.isfinite(self.fresh)) or self.is_few(series, ends, forgotten)

    def is_few(self, series: Series, ends: Floats, forgotten: Floats) -> bool:
        """Whether after each of some blocks there are too few readings for a period; see `is_settled`."""
        t, _ = self.joined(series)
        dropped = self._outdated(t, forgotten[:-1])
        count = np.searchsorted(t, ends) - np.concatenate([[0], dropped])
        return bool(np.all(count < MIN_READINGS_FOR_PERIOD))

    @property
    def limit(self) -> float:
        """Duration [s] for which a reading is valid."""
        return MAX_FRESH if np.isnan(self.fresh) else self.fresh

    @property
    def is_slow(self) -> bool:
        """True if the period of the sender is known to be above SLOW_PERIOD."""
        return self.fresh > FRESH_PERIODS * SLOW_PERIOD

    def drop(self, wrong: Mask) -> None:
        """Remove readings (n,)."""
        self.t, self.value = self.t[~wrong], self.value[~wrong]

    def forget(self, before: float) -> None:
        """Drop what is older than ``before`` [s]."""
        first = int(self._outdated(self.t, np.array([before]))[0])
        self.t, self.value = self.t[first:], self.value[first:]

    def _outdated(self, t: Floats, before: Floats) -> NDArray[np.intp]:
        """How many of the times ``t`` (n,) are not needed once all ``before`` some times (m,) [s] is dropped."""
        # One reading before the horizon stays: it is the one that is held.
        return np.maximum(np.searchsorted(t, before - self._memory) - 1, 0)

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

    def means(self, edges: Floats, known_to: Floats) -> tuple[Floats, Mask]:
        """`cell_means` (n,) of these readings between ``edges`` (n + 1,) [s].

        Each from the readings before its time ``known_to`` (n,) [s], which is later than its edges.
        """
        mean, there = cell_means(self.t, self.value, edges, self.limit)
        if len(self.t) and known_to[0] <= self.t[-1]:
            newest = self.t[np.maximum(np.searchsorted(self.t, known_to) - 1, 0)]
            there &= edges[1:] <= newest
            mean = np.where(there, mean, np.nan)
        return mean, there


def block_bounds(t: Floats, ends: Floats) -> NDArray[np.intp]:
    """Places (k + 1,) in times ``t`` (n,) [s], ascending, between which blocks lie that end at ``ends`` (k,) [s]."""
    return np.concatenate([[0], np.searchsorted(t, ends[:-1]), [len(t)]])


def cell_means(t: Floats, value: Floats, edges: Floats, limit: float) -> tuple[Floats, Mask]:
    """Mean over each cell between ``edges`` (n + 1,) of the straight lines through readings.

    NaN in a cell that a line longer than ``limit`` [s], or one from a NaN reading, passes through; the second array
    says in which cells no such long line passes, that is, where there are readings.

    The mean of a cell is computed from the lines in it alone: readings before and after it do not change its rounding.
    """
    low, high = edges[:-1], edges[1:]
    if len(t) < 2:
        return np.full(len(low), np.nan), np.zeros(len(low), dtype=bool)
    width = np.diff(t)
    bad = ~np.isfinite(value)
    known = np.where(bad, 0.0, value)
    slope = np.diff(known) / width
    first = np.clip(np.searchsorted(t, low, side="right") - 1, 0, len(t) - 2)  # line at the lower edge
    last = np.clip(np.searchsorted(t, high, side="left") - 1, 0, len(t) - 2)  # line at the upper edge
    from_low, to_high = t[first + 1] - low, high - t[last]
    ends = from_low * (known[first + 1] - slope[first] * from_low / 2)
    ends += to_high * (known[last] + slope[last] * to_high / 2)
    between = (known[1:] + known[:-1]) / 2 * width
    whole = np.add.reduceat(between, np.column_stack([first + 1, last]).ravel().clip(max=len(width) - 1))[::2]
    middle = known[first] + slope[first] * ((low + high) / 2 - t[first])
    area = ends + np.where(last > first + 1, whole, 0.0)
    mean = np.where(last > first, area / (high - low), middle)

    def touched(flag: Mask) -> Mask:
        count = np.concatenate([[0], np.cumsum(flag)])
        return count[last + 1] > count[first]

    there = ~touched(width > limit) & (low >= t[0]) & (high <= t[-1])
    return np.where(there & ~touched(bad[1:] | bad[:-1]), mean, np.nan), there

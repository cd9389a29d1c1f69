"""Resampling of readings that come at irregular times: last value held, or means of linear interpolation.

No value is held, and no gap interpolated, for longer than FRESH_PERIODS times the usual interval between readings; the
result is NaN there.
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
    """Recent readings of one signal, and the duration for which a reading is valid.

    Readings are kept for ``memory`` [s] beyond the horizon of `forget`.
    """

    def __init__(self, memory: float = 0.0) -> None:
        self._memory = memory
        self.t: Floats = np.empty(0)
        self.value: Floats = np.empty(0)
        self.fresh = np.nan

    def add(self, series: Series) -> int:
        """Add readings in ascending time; returns the number dropped: those at a repeated time or a step back."""
        size = len(self.t)
        self.t, self.value = self.joined(series)
        dropped = len(series.t) - (len(self.t) - size)
        if np.isnan(self.fresh) and len(self.t) >= MIN_READINGS_FOR_PERIOD:
            period = float(np.median(np.diff(self.t)))
            self.fresh = min(max(FRESH_PERIODS * period, MIN_FRESH), MAX_FRESH)
        return dropped

    def joined(self, series: Series) -> tuple[Floats, Floats]:
        """Times [s] and values that `add` of ``series`` would leave."""
        later = series.t > (self.t[-1] if len(self.t) else -np.inf)
        t, value = series.t[later], series.value[later]
        ascending = np.concatenate([[True], t[1:] > np.maximum.accumulate(t)[:-1]]) if len(t) else later[:0]
        return np.concatenate([self.t, t[ascending]]), np.concatenate([self.value, value[ascending]])

    def is_settled(self, series: Series, ends: Floats, forgotten: Floats) -> bool:
        """True if the period of the sender is known, or remains unknown within these blocks.

        They end at ``ends`` (k,) [s]; readings older than ``forgotten`` (k,) [s] are dropped after each.
        """
        return bool(np.isfinite(self.fresh)) or self.is_few(series, ends, forgotten)

    def is_few(self, series: Series, ends: Floats, forgotten: Floats) -> bool:
        """True if too few readings for a period are left after each block; see `is_settled`."""
        t, _ = self.joined(series)
        dropped = self._droppable(t, forgotten[:-1])
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

    def forget(self, horizon: float) -> None:
        """Drop readings older than ``horizon`` [s], but for the last of them."""
        first = int(self._droppable(self.t, np.array([horizon]))[0])
        self.t, self.value = self.t[first:], self.value[first:]

    def _droppable(self, t: Floats, horizons: Floats) -> NDArray[np.intp]:
        """Number (m,) of times ``t`` (n,) that can be dropped at each of the limits ``horizons`` (m,) [s]."""
        # One reading before the horizon stays: it is the one that is held.
        return np.maximum(np.searchsorted(t, horizons - self._memory) - 1, 0)

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
        """Means (n,) over cells between ``edges`` (n + 1,) [s], see `cell_means`, and where there are readings (n,).

        Each cell uses the readings before its time ``known_to`` (n,) [s], which is later than its edges.
        """
        mean, there = cell_means(self.t, self.value, edges, self.limit)
        if len(self.t) and known_to[0] <= self.t[-1]:
            newest = self.t[np.maximum(np.searchsorted(self.t, known_to) - 1, 0)]
            there &= edges[1:] <= newest
            mean = np.where(there, mean, np.nan)
        return mean, there


def block_bounds(t: Floats, ends: Floats) -> NDArray[np.intp]:
    """Indices (k + 1,) into ascending times ``t`` (n,) [s] at the bounds of blocks that end at ``ends`` (k,) [s]."""
    return np.concatenate([[0], np.searchsorted(t, ends[:-1]), [len(t)]])


def cell_means(t: Floats, value: Floats, edges: Floats, limit: float) -> tuple[Floats, Mask]:
    """Mean (n,) of the linear interpolation of readings over each cell between ``edges`` (n + 1,) [s].

    It is NaN in a cell with a line longer than ``limit`` [s], or with a line from a NaN reading. The second array (n,)
    is True in cells without such a long line, which have readings.

    The mean of a cell is computed from the lines in it alone: readings before and after it do not change its rounding.
    """
    low, high = edges[:-1], edges[1:]
    if len(t) < 2:
        return np.full(len(low), np.nan), np.zeros(len(low), dtype=bool)
    width = np.diff(t)
    bad = ~np.isfinite(value)
    filled = np.where(bad, 0.0, value)
    slope = np.diff(filled) / width
    first = np.clip(np.searchsorted(t, low, side="right") - 1, 0, len(t) - 2)  # line at the lower edge
    last = np.clip(np.searchsorted(t, high, side="left") - 1, 0, len(t) - 2)  # line at the upper edge
    from_low, to_high = t[first + 1] - low, high - t[last]
    ends = from_low * (filled[first + 1] - slope[first] * from_low / 2)
    ends += to_high * (filled[last] + slope[last] * to_high / 2)
    between = (filled[1:] + filled[:-1]) / 2 * width
    whole = np.add.reduceat(between, np.column_stack([first + 1, last]).ravel().clip(max=len(width) - 1))[::2]
    middle = filled[first] + slope[first] * ((low + high) / 2 - t[first])
    area = ends + np.where(last > first + 1, whole, 0.0)
    mean = np.where(last > first, area / (high - low), middle)

    def touched(flag: Mask) -> Mask:
        count = np.concatenate([[0], np.cumsum(flag)])
        return count[last + 1] > count[first]

    there = ~touched(width > limit) & (low >= t[0]) & (high <= t[-1])
    return np.where(there & ~touched(bad[1:] | bad[:-1]), mean, np.nan), there

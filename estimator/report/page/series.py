"""Series in time as a page shows them: the minutes that say most, and an overview in bins."""

import numpy as np

from estimator.report.page.plot import SIDE, Axis
from estimator.signals import Floats

BLOCKS = 200  # of the mean line of an overview
DETAIL_DURATION = 300.0  # s of a series that is shown in detail


def telling_minutes(clock: Floats, worth: Floats, ends: Floats | None = None) -> slice:
    """The stretch of at most DETAIL_DURATION with the largest sum of ``worth``.

    Parameters
    ----------
    clock, worth
        Ascending times [s] (n,), and what is summed (n,).
    ends
        Time [s] (n,) that no stretch which begins at a row goes beyond.
    """
    limits = clock + DETAIL_DURATION if ends is None else np.minimum(clock + DETAIL_DURATION, ends)
    last = np.searchsorted(clock, limits, side="right")
    total = np.concatenate([[0.0], np.cumsum(worth)])
    start = int(np.argmax(total[last] - total[:-1]))
    return slice(start, int(last[start]))


def binned(x: Axis, position: Floats, values: Floats, count: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Centres, least, greatest and mean value of equal bins; NaN where a bin is empty."""
    there = np.isfinite(position) & np.isfinite(values)
    values = values[there]
    index = np.minimum((x.at(position[there]) / SIDE * count).astype(int), count - 1)
    n = np.bincount(index, minlength=count)
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    np.minimum.at(low, index, values)
    np.maximum.at(high, index, values)
    mean = np.bincount(index, values, minlength=count) / np.maximum(n, 1)
    low[n == 0] = high[n == 0] = mean[n == 0] = np.nan
    centres = x.low + (np.arange(count) + 0.5) * (x.high - x.low) / count
    return centres, low, high, mean

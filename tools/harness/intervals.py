"""95 % intervals of shares and of statistics of a sample."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

CONFIDENCE = 0.95
RESAMPLES = 2000

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Estimate:
    """A statistic of ``n`` drives with its interval; NaN without drives."""

    value: float
    low: float
    high: float
    n: int


def share(hits: int, n: int) -> Estimate:
    """Share of ``hits`` among ``n``, with Wilson's interval."""
    if n == 0:
        return Estimate(np.nan, np.nan, np.nan, 0)
    interval = binomtest(hits, n).proportion_ci(CONFIDENCE, method="wilson")
    return Estimate(hits / n, float(interval.low), float(interval.high), n)


def bootstrap(statistic: Callable[..., float], *columns: Floats, seed: int = 1) -> Estimate:
    """Percentile bootstrap of a statistic of equally long ``columns`` (n,), rows drawn together."""
    n = len(columns[0])
    if n == 0:
        return Estimate(np.nan, np.nan, np.nan, 0)
    rng = np.random.default_rng(seed)
    rows = rng.integers(0, n, (RESAMPLES, n))
    values = [statistic(*(column[row] for column in columns)) for row in rows]
    low, high = np.quantile(values, [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Estimate(float(statistic(*columns)), float(low), float(high), n)


def calibration_error(confidence: Floats, right: Floats, bins: int = 10) -> float:
    """Expected calibration error: mean gap between ``confidence`` (n,) and share ``right`` (n,) over equal ``bins``.

    Guo, Pleiss, Sun, Weinberger 2017, "On Calibration of Modern Neural Networks".
    """
    cell = np.minimum((confidence * bins).astype(int), bins - 1)
    weight = np.bincount(cell, minlength=bins)
    gap = np.abs(np.bincount(cell, confidence, bins) - np.bincount(cell, right, bins))
    return float(gap.sum() / weight.sum())

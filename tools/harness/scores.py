"""Errors of estimates against the truth, and 95 % intervals of shares and of statistics of a sample."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from estimator.estimates import Marginal

CONFIDENCE, RESAMPLES = 0.95, 2000
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Score:
    """Relative ``error`` and standard deviation ``sd`` of an estimate, and whether its 90 % interval holds the truth.

    ``half_width`` of the interval as a share of the mean.
    """

    error: float
    sd: float
    holds: bool
    half_width: float

    @classmethod
    def of(cls, found: Marginal, truth: float) -> "Score":
        """Compare with the ``truth``."""
        width = (found.q95 - found.q05) / 2 / found.mean
        return cls(found.mean / truth - 1, found.sd / truth, found.q05 <= truth <= found.q95, width)


def rms(errors: Sequence[float] | Floats) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(errors))))


def summary(scores: Sequence[Score], limits: Sequence[float] = ()) -> dict[str, Any]:
    """Figures of the estimates of some drives; errors below each of ``limits`` are counted.

    ``worst`` is the largest error and ``bias`` the mean one; ``holds`` counts intervals that hold the truth.
    """
    error = np.array([score.error for score in scores])
    counts = {f"within_{100 * limit:g}_percent": int((np.abs(error) < limit).sum()) for limit in limits}
    if not scores:
        return {"estimated": 0, **counts, "holds": 0}
    return {
        "estimated": len(scores),
        **counts,
        "median": float(np.median(np.abs(error))),
        "rms": rms(error),
        "worst": float(np.abs(error).max()),
        "bias": float(error.mean()),
        "sd": float(np.mean([score.sd for score in scores])),
        "half_width": float(np.median([score.half_width for score in scores])),
        "holds": sum(score.holds for score in scores),
    }


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

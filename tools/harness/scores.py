"""Errors of estimates against the truth, and whether their intervals hold it."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimator.estimates import Marginal


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


def rms(errors: Sequence[float]) -> float:
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
        "rms": rms(error.tolist()),
        "worst": float(np.abs(error).max()),
        "bias": float(error.mean()),
        "sd": float(np.mean([score.sd for score in scores])),
        "half_width": float(np.median([score.half_width for score in scores])),
        "holds": sum(score.holds for score in scores),
    }

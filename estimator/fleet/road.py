"""Road of a fleet: the mean slope of each place from all passes.

The slope of a pass has an independent error and an error common to other passes. The common one is due to A, C and the
mass of its drive, and to the road's prior if only that separates a rolling resistance from a slope. It is similar for
vehicles on the same road, so it counts as one error of all passes of a place, in proportion to the common sd of each.
The mean, weighted by the independent variances u_i, is

    sum w_i z_i,   w_i = (1/u_i) / sum (1/u_j),   variance = 1 / sum (1/u_j) + (sum w_i c_i)^2

It is taken over the passes with the smallest common sd c_i, as many as make the variance smallest. One drive with an
altimeter so has more weight than a hundred without. If passes scatter by more than their sds, the variance is
multiplied by the mean square of their normalised deviations.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.fleet.passes import Passes
from estimator.road_map import MAX_SLOPE, Cells, RoadMap
from estimator.signals import Floats

# Largest common sd of a place in the map, rise over run: as much as 1 kg/t of rolling resistance, a sixth of that of a
# truck. A map that is less sure shows A and C hardly better than no map does. Passes without an altimeter leave 6e-3.
MAX_COMMON = 1e-3

Counts = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class LearnedRoad:
    """Places (k,) by ascending ``key``: ``slope``, rise over run [1], its ``sd``, numbers of passes and vehicles.

    ``common`` sd is the part of ``sd`` that is an error of many places together.
    ``scatter`` is the sd of the passes about the mean, NaN for one pass.
    """

    key: Cells
    slope: Floats
    sd: Floats
    common: Floats
    scatter: Floats
    passes: Counts
    vehicles: Counts

    @property
    def map(self) -> RoadMap:
        """Map for a gateway: places whose common sd is small enough to separate a slope from a rolling resistance."""
        kept = (np.abs(self.slope) <= MAX_SLOPE) & (self.common <= MAX_COMMON)
        return RoadMap(self.key[kept], self.slope[kept], self.common[kept])


def learned(vehicles: Sequence[str], drives: Sequence[Passes]) -> LearnedRoad:
    """Learn the road from the passes of each of ``drives`` of ``vehicles``."""
    counts = [len(passes.row) for passes in drives]
    _, numbers = np.unique(np.array(vehicles, dtype=np.str_), return_inverse=True)
    key = np.concatenate([np.empty(0, np.int64), *(passes.keys for passes in drives)])
    z, independent, common = (np.concatenate([np.empty(0), *(passes.values[i] for passes in drives)]) for i in range(3))
    vehicle = np.repeat(numbers, counts)
    order = np.lexsort((vehicle, z, independent, common, key))
    key, vehicle = key[order], vehicle[order]
    z, independent, common = z[order], independent[order], common[order]
    first = np.flatnonzero(np.diff(key, prepend=-1))
    passes = np.diff(np.append(first, len(key)))
    mean, variance, shared = _combined(z, independent**2, common, first, passes)
    off = (z - np.repeat(mean, passes)) ** 2
    others = np.maximum(passes - 1, 1)
    wider = np.sqrt(np.maximum(_sums(off / (independent**2 + common**2), first) / others, 1.0))
    pairs = np.unique(np.column_stack([key, vehicle]), axis=0)
    return LearnedRoad(
        key=key[first],
        slope=mean,
        sd=wider * np.sqrt(variance),
        common=wider * shared,
        scatter=np.where(passes > 1, np.sqrt(_sums(off, first) / others), np.nan),
        passes=passes,
        vehicles=np.unique(pairs[:, 0], return_counts=True)[1],
    )


def _combined(z: Floats, u: Floats, c: Floats, first: Counts, passes: Counts) -> tuple[Floats, Floats, Floats]:
    """Mean, variance and common sd (k,) of places whose passes (n,) begin at ``first`` (k,), by ascending common sd."""
    if not len(first):
        return np.empty(0), np.empty(0), np.empty(0)
    weight, shown, shared = (_running(values, first, passes) for values in (1 / u, z / u, c / u))
    variance = 1 / weight + (shared / weight) ** 2  # with all passes up to each
    least = np.minimum.reduceat(variance, first)
    at_least = np.flatnonzero(variance == np.repeat(least, passes))
    best = at_least[np.searchsorted(at_least, first)]  # the first pass with which it is least
    return (shown / weight)[best], least, (shared / weight)[best]


def _running(values: Floats, first: Counts, passes: Counts) -> Floats:
    """Cumulative sums (n,) of the values (n,) within each place."""
    total = np.cumsum(values)
    return total - np.repeat(total[first] - values[first], passes)


def _sums(values: Floats, first: Counts) -> Floats:
    total: Floats = np.add.reduceat(values, first) if len(first) else np.empty(0)
    return total

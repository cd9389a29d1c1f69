"""Prior probability of times that no signal shows: those of a Markov chain of two states.

It is switched on about once in exp(CHANGE_COST) s, and off after a dwell of exponential length. Where the force is not
known, at a standstill or on the brake, the chain goes on unseen: the longer such a gap, the less does the state after
it depend on the one before it.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import exp, inf, lgamma, log

import numpy as np

from estimator.model.design_matrix import Spans, covered
from estimator.model.effects.effect import Effect, Timing
from estimator.signals import Floats
from estimator.strides import DURATION

CHANGE_COST = 5.5  # log of 245: about as many times are equally likely for a change
MAX_DWELL_FACTOR = 6.0  # by which the mean stretch may be shorter than a usual one, and any stretch longer
MAX_ON_SHARE = 0.9  # of the drive: an effect that is on longer is hardly separated from a constant one
MIN_GAP = DURATION  # s without strides: in less there is one time for a change, as between two strides


@dataclass(frozen=True)
class Costs:
    """Of what a state does between two strides, against staying off: being switched on or off, or staying on."""

    begins: float
    ends: float
    stays: float


def in_gap(gap: float, dwell: float) -> Costs:
    """Of a chain with a mean ``dwell`` [s] in a ``gap`` [s]; nothing is more likely than staying off."""
    on, off = exp(-CHANGE_COST), 1.0 / dwell  # 1/s
    share = on / (on + off)
    forgotten = 1.0 - exp(-(on + off) * gap)
    stays_off = 1.0 - share * forgotten
    return Costs(
        begins=max(log(stays_off / (share * forgotten)), 0.0),
        ends=max(log(stays_off / ((1.0 - share) * forgotten)), 0.0),
        stays=max(log(stays_off / (1.0 - (1.0 - share) * forgotten)), 0.0),
    )


def least_costs(gap: float, effect: Effect) -> Costs:
    """Of a change in ``gap`` [s] by any dwell of an effect; as if seen in short gaps.

    A window begins and ends at places, and little way is made in gaps: an end costs as much there as elsewhere.
    """
    if gap < MIN_GAP or effect.timing is Timing.WINDOW:
        return Costs(CHANGE_COST, CHANGE_COST, 0.0)
    each = [in_gap(gap, dwell) for dwell in effect.dwells]
    return Costs(min(c.begins for c in each), min(c.ends for c in each), min(c.stays for c in each))


@dataclass(frozen=True)
class _Piece:
    """Times of a span in one run of strides: for how long [s], whether it begins and ends there, the gaps [s] beside.

    The gaps at the ends of the drive are endless.
    """

    run: int
    duration: float
    begins: bool
    ends: bool
    before: float
    after: float

    def cost(self, dwell: float, is_on_before: bool, is_on_after: bool) -> float:
        """Minus the log prior probability by a ``dwell`` [s], with the state at the other side of the gaps."""
        total = self.duration / dwell
        if self.begins:
            total += CHANGE_COST
        else:
            gap = in_gap(self.before, dwell)
            total += gap.stays if is_on_before else gap.begins
        if self.ends:
            return total + log(dwell)
        return total if is_on_after else total + in_gap(self.after, dwell).ends


def _pieces(spans: Spans, t: Floats) -> Iterator[_Piece]:
    """Of ``spans`` in order, in runs of strides at ``t`` (n,) [s]."""
    first = np.flatnonzero(np.diff(t, prepend=-inf) >= DURATION + MIN_GAP)
    begin, end = t[first].tolist(), t[np.append(first[1:], len(t)) - 1].tolist()
    gaps = [inf, *(b - a - DURATION for a, b in zip(end[:-1], begin[1:], strict=True)), inf]
    for start, stop in spans:
        for run in range(int(np.searchsorted(end, start - DURATION / 2)), len(begin)):
            low, high = begin[run] - DURATION / 2, end[run] + DURATION / 2
            if low >= stop:
                break
            seen = min(stop, high) - max(start, low)
            if seen > 0.0:
                yield _Piece(run, seen, start > begin[run], stop < end[run], gaps[run], gaps[run + 1])


def is_usual(spans: Spans, effect: Effect, t: Floats) -> bool:
    """Whether the mean stretch is not much shorter than a usual dwell, and none is seen for much longer.

    Windows may be any. None act nearly always on a drive with strides at ``t`` (n,) [s].
    """
    if covered(t, DURATION, spans).mean() > MAX_ON_SHARE:
        return False
    if effect.timing is Timing.WINDOW:
        return len(spans) == 1
    mean = sum(end - start for start, end in spans) / max(len(spans), 1)
    longest = max((piece.duration for piece in _pieces(spans, t)), default=0.0)
    return mean > min(effect.dwells) / MAX_DWELL_FACTOR and longest < MAX_DWELL_FACTOR * max(effect.dwells)


def prior_cost(spans: Spans, effect: Effect, t: Floats) -> float:
    """Minus the log prior probability of times of an effect on a drive with strides at ``t`` (n,) [s].

    Each piece has the nearest of the effect's dwells.
    """
    if effect.timing is Timing.WINDOW:
        return sum(log(t[-1] - t[0]) for span in spans for edge in span if t[0] < edge < t[-1])
    pieces = list(_pieces(spans, t))
    lasts = [one.run + 1 == other.run and not (one.ends or other.begins) for one, other in pairwise(pieces)]
    neighbours = zip(pieces, [False, *lasts], [*lasts, False], strict=False)
    total = sum(min(piece.cost(dwell, *on) for dwell in effect.dwells) for piece, *on in neighbours)
    begins = sum(piece.begins or piece.before < inf for piece in pieces) - sum(lasts)
    return total + rate_cost(begins, float(t[-1] - t[0]))


def rate_cost(begins: int, duration: float) -> float:
    """Cost of a number of beginnings in a drive of ``duration`` [s], beyond CHANGE_COST for each.

    How often it is switched on is not known before: the rate has an exponential prior of mean 1/r, r = exp(CHANGE_COST)
    s, so k beginnings have the density r k! / (duration + r)^(k + 1), the integral over all rates.
    """
    return (begins + 1) * log(1.0 + duration * exp(-CHANGE_COST)) - lgamma(begins + 1)


def cost_without_dwell(spans: Spans, t: Floats) -> float:
    """The same, if the state has no usual dwell: it ends as rarely as it begins."""
    gaps = gaps_at([edge for span in spans for edge in span], t)
    begins = sum(bool(t[0] < start) for start, _ in spans)
    total = sum(max(CHANGE_COST - log(max(gap, DURATION)), 0.0) for gap in gaps)
    return total + rate_cost(begins, float(t[-1] - t[0]))


def gaps_at(edges: Sequence[float], t: Floats) -> list[float]:
    """Gaps [s] between strides, at ``t`` (n,) [s], where those of the ``edges`` [s] lie that are within the drive."""
    after = np.searchsorted(t, [edge for edge in edges if t[0] < edge < t[-1]])
    gaps: list[float] = (t[after] - t[after - 1] - DURATION).tolist()
    return gaps

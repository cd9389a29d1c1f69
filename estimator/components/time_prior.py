"""Compute the prior probability of times that no signal shows, by a Markov chain of two states, off and on.

The chain switches on about once in exp(CHANGE_COST) s, and off after a dwell with an exponential distribution. It
continues unobserved in gaps without known force, at a standstill or while braking. The longer the gap, the less the
state after it depends on the state before it.
"""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from math import exp, inf, lgamma, log

import numpy as np

from estimator.model.effects.effect import Effect, Timing
from estimator.model.spans import Spans, covered
from estimator.signals import Floats
from estimator.strides import DURATION

CHANGE_COST = 5.5  # log of 245: about as many times are equally likely for a change
MAX_DWELL_FACTOR = 6.0  # by which the mean time may be shorter than a usual dwell, and any time longer
MAX_ON_SHARE = 0.9  # of the drive: an effect that is on longer is hardly separated from a constant one
MIN_GAP = DURATION  # s without strides: in less there is one time for a change, as between two strides
DWELL_COST = 2.0  # log of the e-foldings from seconds to the drive's length, where no dwell is usual


@dataclass(frozen=True)
class Costs:
    """Prior costs [nats] of transitions between two strides, relative to off-off: off-on, on-off and on-on."""

    begins: float
    ends: float
    stays: float


@lru_cache(maxsize=2**14)  # effects with the same dwells ask for the same gaps
def gap_costs(gap: float, dwell: float) -> Costs:
    """Costs of the transitions of a chain with mean ``dwell`` [s] over a ``gap`` [s]; none is negative."""
    share, forgotten = _share_and_forgotten(gap, dwell)
    stays_off = 1.0 - share * forgotten
    return Costs(
        begins=max(log(stays_off / (share * forgotten)), 0.0),
        ends=max(log(stays_off / ((1.0 - share) * forgotten)), 0.0),
        stays=max(log(stays_off / (1.0 - (1.0 - share) * forgotten)), 0.0),
    )


def probability_of_restart(gap: float, dwell: float) -> float:
    """Probability that a chain that is on before and after a ``gap`` [s] was off within it."""
    share, forgotten = _share_and_forgotten(gap, dwell)
    return 1.0 - exp(-gap / dwell) / (1.0 - (1.0 - share) * forgotten)


def _share_and_forgotten(gap: float, dwell: float) -> tuple[float, float]:
    """Share of time for which a chain is on, and the loss 1 - rho of its autocorrelation rho over a ``gap`` [s]."""
    on, off = exp(-CHANGE_COST), 1.0 / dwell  # 1/s
    return on / (on + off), 1.0 - exp(-(on + off) * gap)


def least_costs(gap: float, effect: Effect) -> Costs:
    """Smallest costs of transitions over a ``gap`` [s] by any dwell of an effect; a gap below MIN_GAP counts as none.

    A window has equal costs in all gaps, since these costs only propose times, and `prior_cost` judges them.
    """
    if gap < MIN_GAP or effect.timing is Timing.WINDOW:
        return Costs(CHANGE_COST, CHANGE_COST, 0.0)
    costs = [gap_costs(gap, dwell) for dwell in effect.dwell_times]
    return Costs(min(c.begins for c in costs), min(c.ends for c in costs), min(c.stays for c in costs))


@dataclass(frozen=True, kw_only=True)
class _Piece:
    """Part of a span within one run of strides [s]; with the adjoining gaps [s], 0 inside the run."""

    span: int
    run: int
    start: float
    stop: float
    gap_before: float  # endless at the beginning of the drive
    gap_after: float  # and at its end

    @property
    def duration(self) -> float:
        """Observed duration [s]."""
        return self.stop - self.start

    def meets(self, other: "_Piece") -> bool:
        """True if only a gap separates this piece from the ``other``, which follows."""
        return self.run + 1 == other.run and min(self.gap_after, other.gap_before) > 0.0


@lru_cache(maxsize=8)  # drives: the times of all terms of a drive are on the same strides
def _runs(t: bytes) -> tuple[list[float], list[float], list[float]]:
    """First and last stride (r,) [s] of each run of strides at ``t``, and gaps (r + 1,) [s] around the runs."""
    times = np.frombuffer(t)
    first = np.flatnonzero(np.diff(times, prepend=-inf) >= DURATION + MIN_GAP)
    begin, end = times[first].tolist(), times[np.append(first[1:], len(times)) - 1].tolist()
    return begin, end, [inf, *(b - a - DURATION for a, b in zip(end[:-1], begin[1:], strict=True)), inf]


def _pieces(spans: Spans, t: Floats) -> list[_Piece]:
    """Cut ``spans``, in order, into pieces within runs of strides at ``t`` (n,) [s]."""
    begin, end, gaps = _runs(t.tobytes())
    pieces = list[_Piece]()
    for number, (start, stop) in enumerate(spans):
        for run in range(bisect_left(end, start - DURATION / 2), len(begin)):
            low, high = max(start, begin[run] - DURATION / 2), min(stop, end[run] + DURATION / 2)
            if low >= stop:
                break
            if low >= high:
                continue
            before = 0.0 if start > begin[run] else gaps[run]
            after = 0.0 if stop < end[run] else gaps[run + 1]
            if pieces and pieces[-1].run == run:  # two of one run: neither reaches the gap between runs there
                pieces[-1], before = replace(pieces[-1], gap_after=0.0), 0.0
            piece = _Piece(span=number, run=run, start=low, stop=high, gap_before=before, gap_after=after)
            pieces.append(piece)
    return pieces


def _gaps(t: Floats) -> Floats:
    """Gaps (g,) [s] between runs of strides at ``t`` (n,) [s]."""
    between = np.diff(t) - DURATION
    return between[between >= MIN_GAP]


def _periods(pieces: Sequence[_Piece], apart: bool) -> list[list[_Piece]]:
    """Group consecutive pieces that only gaps separate; if ``apart``, those of one span only."""
    periods = list[list[_Piece]]()
    for piece in pieces:
        last = periods[-1][-1] if periods else None
        if last is not None and last.meets(piece) and not (apart and last.span != piece.span):
            periods[-1].append(piece)
        else:
            periods.append([piece])
    return periods


def observed_spans(spans: Spans, t: Floats) -> Spans:
    """Part of ``spans`` on strides at ``t`` (n,) [s]; spans with equal parts cannot be distinguished."""
    return tuple((piece.start, piece.stop) for piece in _pieces(spans, t))


def is_usual(spans: Spans, effect: Effect, t: Floats) -> bool:
    """True if the spans of an effect have usual durations on a drive with strides at ``t`` (n,) [s].

    Their mean exceeds the shortest dwell / MAX_DWELL_FACTOR, and the longest observed one is below MAX_DWELL_FACTOR
    times the longest dwell. A window may have any duration, but there is one. No effect may act for more than
    MAX_ON_SHARE of the drive, or never.
    """
    if not 0.0 < covered(t, DURATION, spans).mean() <= MAX_ON_SHARE:
        return False
    if effect.timing is Timing.WINDOW:
        return len(spans) == 1
    mean = sum(end - start for start, end in spans) / len(spans)
    longest = max(piece.duration for piece in _pieces(spans, t))
    return mean > min(effect.dwell_times) / MAX_DWELL_FACTOR and longest < MAX_DWELL_FACTOR * max(effect.dwell_times)


def prior_cost(spans: Spans, effect: Effect, t: Floats) -> float:
    """Prior cost [nats] of times of an effect on strides at ``t`` (n,) [s]: minus their log prior probability.

    Each time has that dwell of the effect for which its cost is least.
    """
    if effect.timing is Timing.WINDOW:
        return sum(_cost_of_end(_gap_at(edge, t), t) for span in spans for edge in span if t[0] < edge < t[-1])
    pieces = _pieces(spans, t)
    return _periods_cost(_periods(pieces, apart=False), effect.dwell_times, _duration_off(pieces, t), t)


def _cost_of_end(gap: float, t: Floats) -> float:
    """Prior cost [nats] of an end of a window at strides ``t`` (n,) [s], or in a ``gap`` [s] between two of them.

    With equal probability it depends on place (a wet road) or on time (a tyre that goes soft). A gap has little
    distance, but all of its time.
    """
    by_place, by_time = 1.0 / len(t), max(gap, DURATION) / (t[-1] - t[0] + DURATION)
    return -log(0.5 * (by_place + by_time))


def _gap_at(edge: float, t: Floats) -> float:
    """Duration [s] of the gap between strides at ``t`` (n,) [s] around an edge; below MIN_GAP if there is no gap."""
    after = int(np.clip(np.searchsorted(t, edge), 1, len(t) - 1))
    return float(t[after] - t[after - 1]) - DURATION


def cost_apart(spans: Spans, dwells: Sequence[float], t: Floats) -> float:
    """Prior cost [nats] of spans that are independent states, each of which may begin while another one lasts.

    Two spans that adjoin within a run have one change between them.
    """
    pieces = _pieces(spans, t)
    shared = sum(a.run == b.run and a.stop == b.start for a, b in pairwise(pieces))
    return _periods_cost(_periods(pieces, apart=True), dwells, len(t) * DURATION, t) - CHANGE_COST * shared


def _periods_cost(periods: Sequence[Sequence[_Piece]], dwells: Sequence[float], duration: float, t: Floats) -> float:
    """Prior cost [nats] of the times ``periods``, each of which may begin within the observed ``duration`` [s]."""
    total, begins = 0.0, 0.0
    for period in periods:
        cost, dwell = min((_period_cost(dwell, period), dwell) for dwell in dwells)
        total += cost
        begins += 1.0 + sum(probability_of_restart(piece.gap_after, dwell) for piece in period[:-1])
    dwell, gaps = max(dwells), _gaps(t)
    unseen = float((dwell * -np.expm1(-gaps / dwell)).sum())  # s of gaps, after whose beginnings it would be on
    return total + rate_cost(begins, duration + unseen)


def _period_cost(dwell: float, period: Sequence[_Piece]) -> float:
    """Prior cost [nats] of one period, with a mean ``dwell`` [s]."""
    before, after = period[0].gap_before, period[-1].gap_after
    total = sum(piece.duration for piece in period) / dwell
    total += sum(gap_costs(piece.gap_after, dwell).stays for piece in period[:-1])
    total += gap_costs(before, dwell).begins if before else CHANGE_COST
    return total + (gap_costs(after, dwell).ends if after else log(dwell))


def _duration_off(pieces: Sequence[_Piece], t: Floats) -> float:
    """Duration [s] for which the state is observed to be off."""
    return max(len(t) * DURATION - sum(piece.duration for piece in pieces), 0.0)


def rate_cost(begins: float, duration: float) -> float:
    """Prior cost [nats] of k = ``begins`` beginnings within a ``duration`` [s], beyond CHANGE_COST for each.

    The rate of beginnings is unknown: it has an exponential prior of mean 1/r, with r = exp(CHANGE_COST) s. The
    integral over all rates gives the density r k! / (duration + r)^(k + 1).
    """
    return (begins + 1) * log(1.0 + duration * exp(-CHANGE_COST)) - lgamma(begins + 1)


def cost_without_dwell(spans: Spans, t: Floats) -> float:
    """Prior cost [nats] of times of a state without a usual dwell: ends have the same rate as beginnings."""
    pieces = _pieces(spans, t)
    periods = _periods(pieces, apart=False)
    ends = [gap for period in periods for gap in (period[0].gap_before, period[-1].gap_after) if gap < inf]
    total = sum(max(CHANGE_COST - log(max(gap, DURATION)), 0.0) for gap in ends) + DWELL_COST * len(periods)
    return total + rate_cost(len(periods), _duration_off(pieces, t))


def cost_of_leaving(edge: float, is_end: bool, effect: Effect, t: Floats) -> float:
    """Change of the prior cost [nats] if an ``edge`` [s] moves out of its gap; 0 if it lies in none."""
    gap = _gap_at(edge, t)
    if gap < MIN_GAP:
        return 0.0
    if effect.timing is Timing.WINDOW:
        return _cost_of_end(0.0, t) - _cost_of_end(gap, t)
    least = least_costs(gap, effect)
    return log(min(effect.dwell_times)) - least.ends if is_end else CHANGE_COST - least.begins

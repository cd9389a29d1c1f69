"""Times of an effect that no signal shows: those with most evidence, by exchange of runs of blocks.

Amplitude b and times z (one of two states a block) have the log evidence

    1/2 (z's)^2 / (z'Gz + 1/sd^2) - 1/2 log(1 + sd^2 z'Gz) - costs of changes of state

with s and G the scores and products of a profile cut into blocks, off everything else in the model. Blocks end where a
step of the state would score most, and at gaps without strides (costs: `time_prior.py`). A run of blocks is switched on
or off as long as that gains; every run is tried.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from estimator.components.component import Frame
from estimator.components.likelihood import JointLikelihood
from estimator.components.time_prior import MAX_ON_SHARE, Costs, cost_of_leaving, least_costs, prior_cost
from estimator.model.design_matrix import Spans, Term, covered
from estimator.model.effects.effect import Effect, Timing
from estimator.signals import Floats, Mask
from estimator.strides import DURATION

BLOCK_DURATION = 30.0  # s, of strides that share a state
PROFILE_DIGITS = 9  # of a profile, over its largest value: effects whose profiles are equal to so many share products
PROBED_STEPS = 60  # steps whose strength is computed; that of the others is interpolated
MIN_STEP_DISTANCE = 5  # strides between two steps of the state
MAX_STEPS = 200  # of the state that are considered: bounds the cost of the exchanges
MIN_BLOCK_GAP = 5.0  # s without strides, where blocks end: in less the state hardly changes unseen
MAX_RUN = 2000.0  # s, of the blocks exchanged at once
MAX_EXCHANGES = 60  # bounds the cost
STEPS = np.concatenate([np.arange(1, 11) / 10, np.arange(1.5, 4.5, 0.5)])  # s, by which an edge is moved
MOVES = np.concatenate([-STEPS, STEPS])


@dataclass(frozen=True, kw_only=True)
class _Cut:
    """A profile cut into b blocks: their numbers (n,) by stride, products and scores off a set.

    ``lengths`` (b,) of the blocks and ``gaps`` (b - 1,) between them [s].
    """

    labels: NDArray[np.int64]
    lengths: Floats
    gaps: Floats
    products: Floats
    score: Floats


class Switching:
    """Times of effects beside components of one likelihood; effects with one profile share its products."""

    def __init__(self, joint: JointLikelihood) -> None:
        self._joint = joint
        self._cuts: dict[tuple[tuple[int, ...], tuple[int, ...], bytes], _Cut] = {}

    def best(self, chosen: Sequence[int], effect: Effect, own: Sequence[int] = ()) -> tuple[Spans, float] | None:
        """Spans in which ``effect`` acts beside a set, and the cost of their changes; None where no times gain.

        ``own``: components of the effect with times that were found before; changes from them are likely too.
        """
        column, single = self._joint.frame.column(Term(effect)), effect.timing is Timing.WINDOW
        size = float(column[np.argmax(np.abs(column))])
        profile = np.round(column / size, PROFILE_DIGITS)
        key = tuple(chosen), tuple(own), profile.tobytes()
        if key not in self._cuts:
            self._cuts[key] = self._cut(list(chosen), profile, list(own))
        cut, sd = self._cuts[key], effect.usual(self._joint.frame.road_load)
        costs = [least_costs(gap, effect) for gap in cut.gaps.tolist()]
        blocks = exchanged(cut.products * size**2, cut.score * size, sd, effect.positive, single, cut.lengths, costs)
        on = blocks[cut.labels]
        if not on.any() or on.mean() > MAX_ON_SHARE:
            return None
        spans = _spans(self._joint.frame, on)
        return spans, prior_cost(spans, effect, self._joint.frame.strides.t)

    def _cut(self, chosen: list[int], column: Floats, own: list[int]) -> _Cut:
        """A ``column`` (n,) cut where its state most likely changes beside a set, at gaps, and at regular times."""
        t, steps = self._joint.frame.strides.t, np.zeros(len(self._joint.frame.strides), dtype=bool)
        steps[likely_steps(self._joint, chosen, column)] = True
        if own:
            steps[likely_steps(self._joint, [*chosen, *own], column)] = True
            edges = np.array([edge for i in own for span in self._joint.components[i].spans or () for edge in span])
            steps[np.clip(np.searchsorted(t, edges), 1, len(t) - 1)] = True
        block = max(BLOCK_DURATION, float(t[-1] - t[0]) / MAX_STEPS)
        regular = np.insert(np.diff(np.floor((t - t[0]) / block)) > 0, 0, False)
        gap = np.diff(t, prepend=t[0]) >= DURATION + MIN_BLOCK_GAP
        there, place = np.unique(np.cumsum(steps | regular | gap), return_inverse=True)
        products, score = self._joint.projected(chosen, _parts(column, place))
        first = np.searchsorted(place, np.arange(len(there)))
        gaps = t[first[1:]] - t[first[1:] - 1] - DURATION
        lengths = np.append(t[first[1:]], t[-1]) - t[first]
        return _Cut(labels=place, lengths=lengths, gaps=gaps, products=products, score=score)

    def proposed(self, effect: Effect) -> set[Spans]:
        """Times that ``effect`` may have beside the other components."""
        components = self._joint.components
        others = [i for i, component in enumerate(components) if component.name != effect.name]
        own = [i for i, component in enumerate(components) if component.name == effect.name and component.spans]
        return self._found(effect, others, own)

    def proposed_instead(self, effect: Effect) -> set[Spans]:
        """Times that ``effect`` may have in the place of all components with times; none where it alone has any."""
        components = self._joint.components
        timed = [i for i, component in enumerate(components) if component.is_timed]
        others = [i for i, component in enumerate(components) if component.name != effect.name and i not in timed]
        return self._found(effect, others, timed) if any(components[i].name != effect.name for i in timed) else set()

    def _found(self, effect: Effect, beside: list[int], before: list[int]) -> set[Spans]:
        """The best times beside a set, and those of components that it may replace, with the best edges.

        At a steady speed one effect on and another off give the same residual (drafting and a fan), so the times
        between are proposed as well.
        """
        is_window = effect.timing is Timing.WINDOW
        best = self.best(beside, effect, before)
        known = {spans for i in before if (spans := self._joint.components[i].spans) and not (is_window and spans[1:])}
        times = known | (set() if best is None else {best[0]})
        found = {with_refined_edges(self._joint, beside, Term(effect, None, spans)) for spans in times}
        return found if is_window else found | {_between(spans, self._joint.frame.strides.t) for spans in found}


def _between(spans: Spans, t: Floats) -> Spans:
    """The times of the drive that are in none of ``spans``."""
    edges = [float(t[0]), *(edge for span in spans for edge in span), float(t[-1])]
    return tuple((a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a)


def with_refined_edges(joint: JointLikelihood, chosen: list[int], term: Term) -> Spans:
    """Spans of ``term`` whose beginnings and ends are moved by up to the last of STEPS where that adds evidence.

    More than it costs to leave the gap that one lies in.

    Moving an edge changes the column of a few strides, so the evidence of any moves follows from the products of these
    strides.
    """
    spans, t = term.spans or (), joint.frame.strides.t
    edges = [(i, side) for i in range(len(spans)) for side in (0, 1) if t[0] < spans[i][side] < t[-1]]
    profile = joint.frame.column(replace(term, spans=None))
    half = 0.5 * min([2.1 * STEPS.max(), *(b - a for a, b in spans), *(b[0] - a[1] for a, b in pairwise(spans))])
    moves = MOVES[np.abs(MOVES) < half]
    column = joint.frame.column(term)
    near = _reached(t, [spans[i][side] for i, side in edges], float(np.abs(moves).max(initial=0.0)))
    each = [profile[near] * _moved(t[near], spans[i][side], move, side) for i, side in edges for move in moves]
    changes = np.array(each).reshape(-1, len(near))
    single = sp.csc_array((np.ones(len(near)), near, np.arange(len(near) + 1)), (len(t), len(near)))
    G, s = joint.projected(chosen, sp.hstack([sp.csc_array(column[:, None]), single], format="csc"))
    made = np.zeros((1 + len(near), 1 + len(changes)))
    made[0, 0], made[1:, 1:] = 1.0, changes.T
    G, s = made.T @ G @ made, made.T @ s
    sd = term.effect.usual(joint.frame.road_load)
    leaving = [cost_of_leaving(spans[i][side], side == 1, term.effect, t) for i, side in edges]
    taken = np.zeros(len(edges), dtype=np.int64) - 1
    score, strength, cross = float(s[0]), float(G[0, 0]), G[0].copy()
    best, paid = float(_evidence(np.array(score), np.array(strength), sd, positive=False)), 0.0
    for _ in range(MAX_EXCHANGES):
        before = best
        for k in range(len(edges)):
            own = 1 + k * len(moves) + np.arange(len(moves))
            if taken[k] >= 0:
                old = own[taken[k]]
                score, strength = score - s[old], strength - 2 * cross[old] + G[old, old]
                cross -= G[old]
                paid -= leaving[k]
            stay = float(_evidence(np.array(score), np.array(strength), sd, positive=False)) - paid
            gains = _evidence(score + s[own], strength + 2 * cross[own] + np.diag(G)[own], sd, positive=False)
            gains -= paid + leaving[k]
            taken[k] = int(np.argmax(gains)) if gains.max(initial=-np.inf) > stay else -1
            best = max(float(gains.max(initial=-np.inf)), stay)
            if taken[k] >= 0:
                new = own[taken[k]]
                score, strength = score + s[new], strength + 2 * cross[new] + G[new, new]
                cross += G[new]
                paid += leaving[k]
        if best <= before + 1e-3:
            break
    found = [list(span) for span in spans]
    for (i, side), move in zip(edges, taken.tolist(), strict=True):
        if move >= 0:
            found[i][side] += float(moves[move])
    return tuple((a, b) for a, b in found)


def _reached(t: Floats, edges: Sequence[float], furthest: float) -> NDArray[np.intp]:
    """Strides (k,) whose share may change when ``edges`` [s] are moved by up to ``furthest`` [s]."""
    reached = np.zeros(len(t), dtype=bool)
    for edge in edges:
        reached |= np.abs(t - edge) < furthest + DURATION / 2
    return np.flatnonzero(reached)


def _moved(t: Floats, edge: float, move: float, side: int) -> Floats:
    """Change (n,) of the share of each stride that is covered, when a span's ``edge`` moves."""
    between = covered(t, DURATION, ((min(edge, edge + move), max(edge, edge + move)),))
    return between if (move > 0) == (side == 1) else -between


def likely_steps(joint: JointLikelihood, chosen: list[int], column: Floats) -> NDArray[np.intp]:
    """Strides at which a state with this ``column`` (n,) most likely changes.

    A step at stride k has the column of all strides from k on. Its score is a sum over the weighed residual, and its
    products are sums over those of the parts between steps.
    """
    n = len(column)
    scores = np.cumsum((column * joint.weighed_residual(chosen))[::-1])[::-1]
    probed = np.unique(np.linspace(1, n - 1, PROBED_STEPS).astype(np.int64))
    parts = _parts(column, np.searchsorted(probed, np.arange(n), side="right"))
    products = joint.projected(chosen, parts)[0][:0:-1, :0:-1]  # from the last part to that behind the first step
    squares = np.diag(products.cumsum(axis=0).cumsum(axis=1))[::-1]
    strength = np.interp(np.arange(n), probed, np.maximum(squares, 1e-12))
    return highest_peaks(np.abs(scores) / np.sqrt(strength))


def _parts(column: Floats, place: NDArray[np.intp]) -> sp.csr_array:
    """A ``column`` (n,) cut into one column for each part, by the number of the part at each stride (n,)."""
    return sp.csr_array((column, place, np.arange(len(column) + 1)), (len(column), int(place.max()) + 1))


def highest_peaks(values: Floats) -> NDArray[np.intp]:
    """Places of up to MAX_STEPS peaks of ``values`` (n,), the highest first, at least MIN_STEP_DISTANCE apart."""
    peaks = 1 + np.flatnonzero((values[1:-1] > values[:-2]) & (values[1:-1] > values[2:]))
    is_free, found = np.ones(len(values), dtype=bool), list[int]()
    for place in peaks[np.argsort(-values[peaks], kind="stable")].tolist():
        if is_free[place] and len(found) < MAX_STEPS:
            found.append(place)
            is_free[max(place - MIN_STEP_DISTANCE + 1, 0) : place + MIN_STEP_DISTANCE] = False
    return np.array(found, dtype=np.intp)


def exchanged(
    G: Floats, s: Floats, sd: float, positive: bool, single: bool, lengths: Floats, costs: Sequence[Costs]
) -> Mask:
    """Blocks (b,) that are on; ``lengths`` [s] of them, ``costs`` (b - 1,) between. ``single``: at most one run."""
    b = len(s)
    on, changes = np.zeros(b, dtype=bool), _Changes(costs)
    first, last = np.triu_indices(b)
    ends = np.insert(np.cumsum(lengths), 0, 0.0)
    short = (ends[last + 1] - ends[first] <= MAX_RUN) | single
    first, last = first[short], last[short] + 1
    corner = np.zeros((b + 1, b + 1))
    corner[1:, 1:] = G.cumsum(axis=0).cumsum(axis=1)
    own = corner[last, last] - corner[first, last] - corner[last, first] + corner[first, first]
    best = 0.0
    for _ in range(MAX_EXCHANGES):
        active = on.astype(float)
        score, strength = float(s @ active), float(active @ G @ active)
        scores, crosses, counts = (np.insert(np.cumsum(each), 0, 0.0) for each in (s, G @ active, active))
        in_run = counts[last] - counts[first]
        runs = np.flatnonzero((in_run == 0) | (in_run == last - first))  # in one state
        begin, end, switch = first[runs], last[runs], np.where(in_run[runs] == 0, 1.0, -1.0)
        more, edges = changes.by_run(on, begin, end)
        scored, crossed = scores[end] - scores[begin], crosses[end] - crosses[begin]
        gain = _evidence(score + switch * scored, strength + 2 * switch * crossed + own[runs], sd, positive)
        gain -= changes.cost(on) + switch * more
        if single:
            gain[_count(on) + switch * edges > 2] = -np.inf
        k = int(np.argmax(gain))
        if gain[k] <= best + 1e-9:
            break
        best = float(gain[k])
        on[begin[k] : end[k]] = switch[k] > 0
    return on


class _Changes:
    """Costs of the states of b blocks, from the ``costs`` (b - 1,) between them."""

    def __init__(self, costs: Sequence[Costs]) -> None:
        self._begins, self._ends, self._stays = (
            np.array([getattr(one, name) for one in costs]) for name in ("begins", "ends", "stays")
        )

    def cost(self, on: Mask) -> float:
        """Of states (b,)."""
        before, after = on[:-1], on[1:]
        return float(self._begins @ (~before & after) + self._ends @ (before & ~after) + self._stays @ (before & after))

    def by_run(self, on: Mask, first: NDArray[np.intp], last: NDArray[np.intp]) -> tuple[Floats, Floats]:
        """Cost (r,) and changes (r,) that the blocks from ``first`` to before ``last`` (r,) make by being on, not off.

        They are in one state before.
        """
        b = len(on)
        left = np.append(np.where(on[:-1], self._stays - self._ends, self._begins), 0.0)
        right = np.append(np.where(on[1:], self._stays - self._begins, self._ends), 0.0)
        within = np.insert(np.cumsum(self._stays), 0, 0.0)
        cost = left[first - 1] + within[last - 1] - within[first] + right[last - 1]
        edges = np.where(first > 0, 1 - 2 * on[first - 1], 0) + np.where(last < b, 1 - 2 * on[last % b], 0)
        return cost, edges.astype(float)


def value(G: Floats, s: Floats, on: Mask, sd: float, positive: bool, costs: Sequence[Costs]) -> float:
    """Log evidence of states (b,), less the cost of their changes; 0 of none."""
    if not on.any():
        return 0.0
    active = on.astype(float)
    gain = _evidence(np.array(s @ active), np.array(active @ G @ active), sd, positive)
    return float(gain) - _Changes(costs).cost(on)


def _evidence(score: Floats, strength: Floats, sd: float, positive: bool) -> Floats:
    precision = np.maximum(strength, 0.0) + sd**-2.0
    gain = 0.5 * score**2 / precision - 0.5 * np.log(precision * sd**2)
    allowed: Floats = np.where((score > 0) | (not positive), gain, -np.inf)
    return allowed


def _count(on: Mask) -> int:
    """Changes of state within the drive."""
    return int(np.count_nonzero(np.diff(on)))


def _spans(frame: Frame, on: Mask) -> Spans:
    edges, t = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]))), frame.strides.t
    return tuple((float(t[a]) - DURATION / 2, float(t[e - 1]) + DURATION / 2) for a, e in edges.reshape(-1, 2).tolist())

"""Times of an effect that no signal shows: those with most evidence, by exchange of runs of blocks.

Amplitude b and times z (one of two states a block) have the log evidence

    1/2 (z's)^2 / (z'Gz + 1/sd^2) - 1/2 log(1 + sd^2 z'Gz) - cost x changes of state

with s and G the scores and products of a profile cut into blocks, off everything else in the model. Blocks end where a
step of the state would score most. A run of blocks is switched on or off as long as that gains; every run is tried.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from estimator.components.component import Frame
from estimator.components.likelihood import JointLikelihood
from estimator.model.design_matrix import Span, Spans, Term, covered
from estimator.model.effects.effect import Effect, Timing
from estimator.signals import Floats, Mask
from estimator.strides import DURATION

BLOCK_DURATION = 30.0  # s, of strides that share a state
PROFILE_DIGITS = 9  # of a profile, over its largest value: effects whose profiles are equal to so many share products
PROBED_STEPS = 60  # steps whose strength is computed; that of the others is interpolated
MIN_STEP_DISTANCE = 5  # strides between two steps of the state
MAX_STEPS = 200  # of the state that are considered: bounds the cost of the exchanges
CHANGE_COST = 5.5  # log of 245: about as many times are equally likely for a change
MAX_DWELL_FACTOR = 6.0  # by which the mean stretch may be shorter than a usual one, and any stretch longer
MAX_RUN = 2000.0  # s, of the blocks exchanged at once
MAX_EXCHANGES = 60  # bounds the cost
STEPS = np.concatenate([np.arange(1, 11) / 10, np.arange(1.5, 4.5, 0.5)])  # s, by which an edge is moved
MOVES = np.concatenate([-STEPS, STEPS])
MAX_ON_SHARE = 0.9  # of the drive: an effect that is on longer is hardly separated from a constant one


@dataclass(frozen=True)
class _Cut:
    """A profile cut into blocks: their numbers (n,) by stride, lengths [s], products and scores off a set."""

    labels: NDArray[np.int64]
    lengths: Floats
    products: Floats
    score: Floats


class Switching:
    """Times of effects beside components of one likelihood; effects with one profile share its products."""

    def __init__(self, joint: JointLikelihood) -> None:
        self._joint = joint
        self._cuts: dict[tuple[tuple[int, ...], bytes], _Cut] = {}

    def best(self, chosen: Sequence[int], effect: Effect, own: Sequence[int] = ()) -> tuple[Spans, float] | None:
        """Spans in which ``effect`` acts beside a set, and the cost of their changes; None where no times gain.

        ``own``: components of the effect with times that were found before; changes from them are likely too.
        """
        column, single = self._joint.frame.column(Term(effect)), effect.timing is Timing.WINDOW
        size = float(column[np.argmax(np.abs(column))])
        profile = np.round(column / size, PROFILE_DIGITS)
        key = (*chosen, *own), profile.tobytes()
        if key not in self._cuts:
            self._cuts[key] = self._cut(list(chosen), profile, list(own))
        cut, sd = self._cuts[key], effect.usual(self._joint.frame.road_load)
        blocks = exchanged(cut.products * size**2, cut.score * size, sd, effect.positive, single, cut.lengths)
        on = blocks[cut.labels]
        if not on.any() or on.mean() > MAX_ON_SHARE:
            return None
        spans = _spans(self._joint.frame, on)
        return spans, prior_cost(spans, effect, self._joint.frame.strides.t)

    def _cut(self, chosen: list[int], column: Floats, own: list[int]) -> _Cut:
        """A ``column`` (n,) cut where its state most likely changes beside a set, and at regular times."""
        t, steps = self._joint.frame.strides.t, np.zeros(len(self._joint.frame.strides), dtype=bool)
        steps[likely_steps(self._joint, chosen, column)] = True
        if own:
            steps[likely_steps(self._joint, [*chosen, *own], column)] = True
            edges = np.array([edge for i in own for span in self._joint.components[i].spans or () for edge in span])
            steps[np.clip(np.searchsorted(t, edges), 1, len(t) - 1)] = True
        block = max(BLOCK_DURATION, float(t[-1] - t[0]) / MAX_STEPS)
        regular = np.insert(np.diff(np.floor((t - t[0]) / block)) > 0, 0, False)
        there, place = np.unique(np.cumsum(steps | regular), return_inverse=True)
        products, score = self._joint.projected(chosen, _parts(column, place))
        first = np.searchsorted(place, np.arange(len(there)))
        return _Cut(place, np.append(t[first[1:]], t[-1]) - t[first], products, score)

    def proposed(self, effect: Effect) -> set[Spans]:
        """Times that ``effect`` may have beside the other components of the likelihood.

        At a steady speed one effect on and another off give the same residual (drafting and a fan), so the times
        between are proposed as well.
        """
        components = self._joint.components
        beside = [i for i, component in enumerate(components) if component.name != effect.name]
        own = [i for i, component in enumerate(components) if component.name == effect.name and component.spans]
        best = self.best(beside, effect, own)
        times = [*(components[i].spans for i in own), *(() if best is None else best[:1])]
        found = {with_refined_edges(self._joint, beside, Term(effect, None, spans)) for spans in times}
        if effect.timing is Timing.WINDOW:
            return found
        return found | {_between(spans, self._joint.frame.strides.t) for spans in found}


def is_usual(spans: Spans, effect: Effect, t: Floats) -> bool:
    """Whether the mean stretch is not much shorter than a usual dwell, and none much longer; windows may be any.

    None act nearly always on a drive with strides at ``t`` (n,) [s].
    """
    if covered(t, DURATION, spans).mean() > MAX_ON_SHARE:
        return False
    if effect.timing is Timing.WINDOW:
        return len(spans) == 1
    lasting = [end - start for start, end in spans]
    mean = sum(lasting) / max(len(lasting), 1)
    longest = MAX_DWELL_FACTOR * max(effect.dwells)
    return mean > min(effect.dwells) / MAX_DWELL_FACTOR and max(lasting, default=0.0) < longest


def prior_cost(spans: Spans, effect: Effect, t: Floats) -> float:
    """Minus the log prior probability of times of an effect on a drive with strides at ``t`` (n,) [s]."""
    if effect.timing is Timing.WINDOW:
        return CHANGE_COST * edges_within(spans, t)
    return sum(cost(span, effect.dwells, t) for span in spans)


def edges_within(spans: Spans, t: Floats) -> int:
    """Beginnings and ends of ``spans`` within a drive with strides at ``t`` (n,) [s]."""
    return sum(bool(t[0] < edge < t[-1]) for span in spans for edge in span)


def _between(spans: Spans, t: Floats) -> Spans:
    """The times of the drive that are in none of ``spans``."""
    edges = [float(t[0]), *(edge for span in spans for edge in span), float(t[-1])]
    return tuple((a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a)


def with_refined_edges(joint: JointLikelihood, chosen: list[int], term: Term) -> Spans:
    """Spans of ``term`` whose beginnings and ends are moved by up to the last of STEPS where that adds evidence.

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
    taken = np.zeros(len(edges), dtype=np.int64) - 1
    score, strength, cross = float(s[0]), float(G[0, 0]), G[0].copy()
    best = float(_evidence(np.array(score), np.array(strength), sd, positive=False))
    for _ in range(MAX_EXCHANGES):
        before = best
        for k in range(len(edges)):
            own = 1 + k * len(moves) + np.arange(len(moves))
            if taken[k] >= 0:
                old = own[taken[k]]
                score, strength = score - s[old], strength - 2 * cross[old] + G[old, old]
                cross -= G[old]
            stay = float(_evidence(np.array(score), np.array(strength), sd, positive=False))
            gains = _evidence(score + s[own], strength + 2 * cross[own] + np.diag(G)[own], sd, positive=False)
            taken[k] = int(np.argmax(gains)) if gains.max(initial=-np.inf) > stay else -1
            best = max(float(gains.max(initial=-np.inf)), stay)
            if taken[k] >= 0:
                new = own[taken[k]]
                score, strength = score + s[new], strength + 2 * cross[new] + G[new, new]
                cross += G[new]
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


def cost(span: Span, dwells: tuple[float, ...], t: Floats) -> float:
    """Of one ``span`` on a drive with strides at ``t``: of its beginning, and of its end by the nearest of the dwells.

    Dwells [s] are exponential, as in a Markov chain of two states. What is on when the drive ends has no end in it; on
    when it begins is as much less likely than off as such a chain is on for less time, but not more likely.
    """
    begins, ends = (bool(t[0] < edge < t[-1]) for edge in span)

    def by(dwell: float) -> float:
        end = float(np.log(dwell))
        beginning = CHANGE_COST if begins else max(CHANGE_COST - end, 0.0)
        return beginning + ends * end + (span[1] - span[0]) / dwell

    return min(by(dwell) for dwell in dwells)


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


def exchanged(G: Floats, s: Floats, sd: float, positive: bool, single: bool, lengths: Floats) -> Mask:
    """Blocks (b,) that are on; ``lengths`` [s] of them. ``single``: at most one run."""
    b = len(s)
    on = np.zeros(b, dtype=bool)
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
        sums = np.vstack([np.zeros(4), np.cumsum(np.column_stack([s, G @ active, active, 1 - active]), axis=0)])
        run = sums[last] - sums[first]
        gains = []
        for switch, pure in ((1.0, run[:, 2] == 0), (-1.0, run[:, 3] == 0)):
            changes = _changes_after(on, first, last, switch > 0)
            gain = _evidence(score + switch * run[:, 0], strength + 2 * switch * run[:, 1] + own, sd, positive)
            allowed = pure & ~(single & (changes > 2))
            gains.append(np.where(allowed, gain - CHANGE_COST * changes, -np.inf))
        which, k = divmod(int(np.argmax(gains)), len(first))
        if gains[which][k] <= best + 1e-9:
            break
        best = float(gains[which][k])
        on[first[k] : last[k]] = which == 0
    return on


def value(G: Floats, s: Floats, on: Mask, sd: float, positive: bool) -> float:
    """Log evidence of states (b,), less the cost of their changes; 0 of none."""
    if not on.any():
        return 0.0
    active = on.astype(float)
    gain = _evidence(np.array(s @ active), np.array(active @ G @ active), sd, positive)
    return float(gain) - CHANGE_COST * _changes(on)


def _evidence(score: Floats, strength: Floats, sd: float, positive: bool) -> Floats:
    precision = np.maximum(strength, 0.0) + sd**-2.0
    gain = 0.5 * score**2 / precision - 0.5 * np.log(precision * sd**2)
    allowed: Floats = np.where((score > 0) | (not positive), gain, -np.inf)
    return allowed


def _changes(on: Mask) -> int:
    """Changes of state within the drive."""
    return int(np.count_nonzero(np.diff(on)))


def _changes_after(on: Mask, first: np.ndarray, last: np.ndarray, state: bool) -> Floats:
    """Changes once the blocks from ``first`` to before ``last`` are in ``state``, all of them in the other before."""
    b = len(on)
    before = np.where(first > 0, on[np.maximum(first - 1, 0)] == state, True)
    after = np.where(last < b, on[np.minimum(last, b - 1)] == state, True)
    ends = np.where(first > 0, np.where(before, -1, 1), 0) + np.where(last < b, np.where(after, -1, 1), 0)
    changes: Floats = _changes(on) + ends
    return changes


def _spans(frame: Frame, on: Mask) -> Spans:
    edges, t = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]))), frame.strides.t
    return tuple((float(t[a]) - DURATION / 2, float(t[e - 1]) + DURATION / 2) for a, e in edges.reshape(-1, 2).tolist())

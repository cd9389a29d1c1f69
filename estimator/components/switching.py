"""Times of an effect that no signal shows: those with most evidence, by exchange of runs of blocks.

Amplitude b and times z (one of two states a block) have the log evidence

    1/2 (z's)^2 / (z'Gz + 1/sd^2) - 1/2 log(1 + sd^2 z'Gz) - cost x changes of state

with s and G the scores and products of a profile cut into blocks, off everything else in the model. Blocks end where a
step of the state would score most. A run of blocks is switched on or off as long as that gains; every run is tried.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.signal import find_peaks

from estimator.components.component import Frame
from estimator.components.likelihood import JointLikelihood
from estimator.model.design_matrix import Spans, Term, covered
from estimator.model.effects.effect import Effect, Timing
from estimator.signals import Floats, Mask
from estimator.strides import DURATION

BLOCK_DURATION = 30.0  # s, of strides that share a state
PROBED_STEPS = 150  # steps whose strength is computed; that of the others is interpolated
MIN_STEP_DISTANCE = 5  # strides between two steps of the state
MAX_STEPS = 200  # of the state that are considered: bounds the cost of the exchanges
CHANGE_COST = 5.5  # log of 245: about as many times are equally likely for a change
MAX_DWELL_FACTOR = 6.0  # by which the mean stretch may be shorter than a usual one, and any stretch longer
MAX_RUN = 2000.0  # s, of the blocks exchanged at once
MAX_EXCHANGES = 60  # bounds the cost
STEPS = np.concatenate([np.arange(1, 11) / 10, np.arange(1.5, 4.5, 0.5)])  # s, by which an edge is moved
MOVES = np.concatenate([-STEPS, STEPS])
MAX_ON_SHARE = 0.9  # of the drive: an effect that is on longer is hardly separated from a constant one


def best_times(joint: JointLikelihood, chosen: list[int], term: Term, single: bool) -> tuple[Spans, float] | None:
    """Spans in which ``term`` acts, and the cost of their changes; None where no times gain.

    ``single``: once, from some time to another.
    """
    column, t = joint.frame.column(term), joint.frame.strides.t
    steps = np.zeros(len(t), dtype=bool)
    steps[likely_steps(joint, chosen, column)] = True
    block = max(BLOCK_DURATION, float(t[-1] - t[0]) / MAX_STEPS)
    labels = np.cumsum(steps | np.insert(np.diff(np.floor((t - t[0]) / block)) > 0, 0, False))
    on = _states(joint, chosen, term, single, labels)
    if not on.any() or on.mean() > MAX_ON_SHARE:
        return None
    spans = _spans(joint.frame, on)
    return spans, CHANGE_COST * _changes(on) if single else sum(
        cost(end - start, term.effect.dwells) for start, end in spans
    )


def proposed_times(joint: JointLikelihood, effect: Effect) -> set[Spans]:
    """Times that ``effect`` may have, beside the components of ``joint`` and beside those of them that always act.

    At a steady speed one effect on and another off give the same residual (drafting and a fan), so the times between
    are proposed as well.
    """
    ours = [i for i, component in enumerate(joint.components) if component.name != effect.name]
    always = [i for i in ours if not joint.components[i].is_timed]
    single, found = effect.timing is Timing.WINDOW, set[Spans]()
    own = [c.spans for c in joint.components if c.name == effect.name and c.spans]
    for beside in [ours] if always == ours else [ours, always]:
        times = best_times(joint, beside, Term(effect), single)
        found |= {
            with_refined_edges(joint, beside, Term(effect, None, spans))
            for spans in (*own, *(() if times is None else times[:1]))
        }
    return found if single else found | {_between(spans, joint.frame.strides.t) for spans in found}


def is_usual(spans: Spans, effect: Effect) -> bool:
    """Whether the mean stretch is not much shorter than a usual dwell, and none much longer; windows may be any."""
    if effect.timing is Timing.WINDOW:
        return len(spans) == 1
    lasting = [end - start for start, end in spans]
    mean = sum(lasting) / max(len(lasting), 1)
    longest = MAX_DWELL_FACTOR * max(effect.dwells)
    return mean > min(effect.dwells) / MAX_DWELL_FACTOR and max(lasting, default=0.0) < longest


def prior_cost(spans: Spans, effect: Effect) -> float:
    """Minus the log prior probability of times of an effect."""
    if effect.timing is Timing.WINDOW:
        return 2 * CHANGE_COST
    return sum(cost(end - start, effect.dwells) for start, end in spans)


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
    each = [profile * _moved(t, spans[i][side], move, side) for i, side in edges for move in moves]
    changes = np.array(each).reshape(-1, len(t))
    near = np.flatnonzero(np.any(changes != 0, axis=0))
    single = np.zeros((len(t), 1 + len(near)))
    single[:, 0], single[near, 1 + np.arange(len(near))] = column, 1.0
    G, s = joint.projected(chosen, single)
    made = np.zeros((1 + len(near), 1 + len(changes)))
    made[0, 0], made[1:, 1:] = 1.0, changes[:, near].T
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


def _moved(t: Floats, edge: float, move: float, side: int) -> Floats:
    """Change (n,) of the share of each stride that is covered, when a span's ``edge`` moves."""
    between = covered(t, DURATION, ((min(edge, edge + move), max(edge, edge + move)),))
    return between if (move > 0) == (side == 1) else -between


def cost(duration: float, dwells: tuple[float, ...]) -> float:
    """Of one span of ``duration`` [s]: of its beginning, and of its end by the nearest of the usual ``dwells`` [s].

    Dwells are exponential, as in a Markov chain of two states.
    """
    return CHANGE_COST + min(float(np.log(dwell)) + duration / dwell for dwell in dwells)


def likely_steps(joint: JointLikelihood, chosen: list[int], column: Floats) -> NDArray[np.intp]:
    """Strides at which a state with this ``column`` (n,) most likely changes.

    A step at stride k has the column of all strides from k on. Its score is a sum over the weighed residual.
    """
    n = len(column)
    scores = np.cumsum((column * joint.weighed_residual(chosen))[::-1])[::-1]
    probed = np.unique(np.linspace(1, n - 1, PROBED_STEPS).astype(np.int64))
    products, _ = joint.projected(chosen, np.where(np.arange(n)[:, None] >= probed, column[:, None], 0.0))
    strength = np.interp(np.arange(n), probed, np.maximum(np.diag(products), 1e-12))
    clarity = np.abs(scores) / np.sqrt(strength)
    peaks, found = find_peaks(clarity, distance=MIN_STEP_DISTANCE, height=0.0)
    return peaks[np.argsort(-found["peak_heights"], kind="stable")[:MAX_STEPS]]


def _states(joint: JointLikelihood, chosen: list[int], term: Term, single: bool, labels: Floats) -> Mask:
    """The states (n,) of strides, the same for those that share a label."""
    there, place = np.unique(labels, return_inverse=True)
    columns = np.zeros((len(labels), len(there)))
    columns[np.arange(len(labels)), place] = joint.frame.column(term)
    products, score = joint.projected(chosen, columns)
    first = np.searchsorted(place, np.arange(len(there)))
    lengths = np.append(joint.frame.strides.t[first[1:]], joint.frame.strides.t[-1]) - joint.frame.strides.t[first]
    sd = term.effect.usual(joint.frame.road_load)
    return exchanged(products, score, sd, term.effect.positive, single, lengths)[place]


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

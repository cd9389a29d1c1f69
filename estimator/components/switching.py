"""Find the times of an effect that no signal shows: those with most evidence beside a set of terms.

The drive is cut into blocks at gaps, and where a change of state has the highest score. Runs of blocks are switched on
or off (`exchange.py`), and the edges of the resulting times are moved (`edges.py`). Two effects may also be searched
together, so that runs pass from one to the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from estimator.components.edges import with_refined_edges
from estimator.components.exchange import SwitchingPrior, best_states
from estimator.components.likelihood import JointLikelihood
from estimator.components.term import Frame
from estimator.components.time_prior import MAX_ON_SHARE, least_costs, prior_cost
from estimator.model.effect_term import EffectTerm
from estimator.model.effects.effect import Effect, Timing
from estimator.model.spans import Spans
from estimator.signals import Floats, Mask
from estimator.strides import DURATION

BLOCK_DURATION = 30.0  # s, of strides that share a state
PROFILE_DIGITS = 9  # of a profile, over its largest value: effects whose profiles are equal to so many share products
PROBED_STEPS = 60  # steps whose strength is computed; that of the others is interpolated
MIN_STEP_DISTANCE = 5  # strides between two steps of the state
MAX_STEPS = 200  # of the state that are considered: bounds the cost of the exchanges
MIN_BLOCK_GAP = 5.0  # s without strides, where blocks end: in less the state hardly changes unseen


@dataclass(frozen=True, kw_only=True)
class _Cut:
    """Profiles of e effects cut into b blocks: ``labels`` (n,) are the block of each stride, ``first`` (b,) its first.

    ``gaps`` (b - 1,) [s] lie between them. ``products`` (e, e, b, b) and ``score`` (e, b) have a set eliminated.
    """

    labels: NDArray[np.int64]
    first: NDArray[np.intp]
    gaps: Floats
    products: Floats
    score: Floats


class Switching:
    """Finds times of effects beside terms of one likelihood; effects with equal profiles share products."""

    def __init__(self, joint: JointLikelihood) -> None:
        self._joint = joint
        self._cuts: dict[tuple[tuple[int, ...], tuple[int, ...], bytes], _Cut] = {}

    def best(self, chosen: Sequence[int], effect: Effect, earlier: Sequence[int] = ()) -> tuple[Spans, float] | None:
        """Spans in which ``effect`` most likely acts beside a set, and their prior cost [nats]; None if none gain.

        ``earlier`` are terms of the effect with earlier times; blocks are also cut at changes from these.
        """
        column = self._joint.frame.column(EffectTerm(effect))
        size = float(column[np.argmax(np.abs(column))])
        profile = np.round(column / size, PROFILE_DIGITS)
        key = tuple(chosen), tuple(earlier), profile.tobytes()
        if key not in self._cuts:
            beside = list(chosen)
            hypotheses = [beside, [*beside, *earlier]] if earlier else [beside]
            self._cuts[key] = self._cut(beside, [profile], hypotheses, self._acting(earlier))
        cut = self._cuts[key]
        off = np.zeros_like(cut.score, dtype=bool)
        prior = self._prior(effect, cut)
        blocks = best_states(cut.products * size**2, cut.score * size, [prior], off)
        on = blocks[0, cut.labels]
        if not on.any() or on.mean() > MAX_ON_SHARE:
            return None
        spans = _spans(self._joint.frame, on)
        return spans, prior_cost(spans, effect, self._joint.frame.strides.t)

    def best_pair(self, effects: tuple[Effect, Effect]) -> dict[str, Spans]:
        """Times of two effects that act, by name: those with most evidence together, found from their present times.

        Runs are switched in either of them, or pass from one to the other; one may lose all of its times.
        """
        terms, frame = self._joint.terms, self._joint.frame
        acting = [next(i for i, term in enumerate(terms) if term.name == effect.name) for effect in effects]
        beside = [i for i in range(len(terms)) if i not in acting]
        states = self._acting(acting)
        cut = self._cut(beside, [frame.column(EffectTerm(effect)) for effect in effects], [[*beside, *acting]], states)
        priors = [self._prior(effect, cut) for effect in effects]
        after = best_states(cut.products, cut.score, priors, states[:, cut.first])
        found = {effect.name: _spans(frame, on[cut.labels]) for effect, on in zip(effects, after, strict=True)}
        for effect in effects:
            timed = {other.name: EffectTerm(other, None, found[other.name]) for other in effects if found[other.name]}
            if term := timed.pop(effect.name, None):
                found[effect.name] = with_refined_edges(self._joint, beside, term, [*timed.values()])
        return found

    def _acting(self, numbers: Sequence[int]) -> Mask:
        """Strides (k, n) at which terms of effects act by over half, at fitted times or as a signal shows."""
        frame = self._joint.frame
        states = np.zeros((len(numbers), len(frame.strides)), dtype=bool)
        for state, i in zip(states, numbers, strict=True):
            effect_term = self._joint.terms[i].effect_term
            assert effect_term is not None
            state[:] = np.abs(frame.column(effect_term)) > 0.5 * np.abs(frame.column(EffectTerm(effect_term.effect)))
        return states

    def _prior(self, effect: Effect, cut: _Cut) -> SwitchingPrior:
        return SwitchingPrior(
            sd=effect.usual_magnitude(self._joint.frame.road_load),
            is_positive=effect.positive,
            is_single=effect.timing is Timing.WINDOW,
            costs=[least_costs(gap, effect) for gap in cut.gaps.tolist()],
        )

    def _cut(self, beside: list[int], profiles: list[Floats], hypotheses: Sequence[list[int]], states: Mask) -> _Cut:
        """Cut ``profiles`` (n,) at likely changes of their states beside ``hypotheses``, and where ``states`` change.

        States have the shape (k, n). Profiles are also cut at gaps, and at regular times. Terms ``beside`` are
        eliminated.
        """
        t, steps = self._joint.frame.strides.t, np.zeros(len(self._joint.frame.strides), dtype=bool)
        for hypothesis, profile in product(hypotheses, profiles):
            steps[likely_steps(self._joint, hypothesis, profile)] = True
        steps[1:] |= (states[:, 1:] != states[:, :-1]).any(axis=0)
        block = max(BLOCK_DURATION, float(t[-1] - t[0]) / MAX_STEPS)
        regular = np.insert(np.diff(np.floor((t - t[0]) / block)) > 0, 0, False)
        gap = np.diff(t, prepend=t[0]) >= DURATION + MIN_BLOCK_GAP
        blocks, label = np.unique(np.cumsum(steps | regular | gap), return_inverse=True)
        parts = sp.hstack([_parts(profile, label) for profile in profiles], format="csc")
        products, score = self._joint.projected(beside, parts)
        e, b = len(profiles), len(blocks)
        first = np.searchsorted(label, np.arange(b))
        return _Cut(
            labels=label,
            first=first,
            gaps=t[first[1:]] - t[first[1:] - 1] - DURATION,
            products=products.reshape(e, b, e, b).swapaxes(1, 2),
            score=score.reshape(e, b),
        )

    def proposed(self, effect: Effect) -> set[Spans]:
        """Propose times of ``effect`` beside the other terms: the best, and its earlier ones, all with refined edges.

        The complements of these times are proposed as well: at a steady speed, one effect on and another one off give
        the same residual (a fan and drafting).
        """
        terms, is_window = self._joint.terms, effect.timing is Timing.WINDOW
        others = [i for i, term in enumerate(terms) if term.name != effect.name]
        earlier = [i for i, term in enumerate(terms) if term.name == effect.name and term.spans]
        best = self.best(others, effect, earlier)
        times = {terms[i].spans or () for i in earlier} | (set() if best is None else {best[0]})
        refined = {with_refined_edges(self._joint, others, EffectTerm(effect, None, spans)) for spans in times}
        t = self._joint.frame.strides.t
        return refined if is_window else refined | {_complement(spans, t) for spans in refined}


def _complement(spans: Spans, t: Floats) -> Spans:
    """Complement of ``spans`` in the drive."""
    first, last = float(t[0]) - DURATION / 2, float(t[-1]) + DURATION / 2
    edges = [first, *(edge for span in spans for edge in span), last]
    return tuple((a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b > a)


def likely_steps(joint: JointLikelihood, chosen: list[int], column: Floats) -> NDArray[np.intp]:
    """Strides at which a state with this ``column`` (n,) most likely changes.

    A step at stride k has the column from stride k on. Its score is a sum over the weighed residual, and its products
    are sums over those of the parts between steps.
    """
    n = len(column)
    scores = np.cumsum((column * joint.weighed_residual(chosen))[::-1])[::-1]
    probed = np.unique(np.linspace(1, n - 1, PROBED_STEPS).astype(np.int64))
    parts = _parts(column, np.searchsorted(probed, np.arange(n), side="right"))
    products = joint.projected(chosen, parts)[0][:0:-1, :0:-1]  # from the last part to that behind the first step
    squares = np.diag(products.cumsum(axis=0).cumsum(axis=1))[::-1]
    strength = np.interp(np.arange(n), probed, np.maximum(squares, 1e-12))
    return highest_peaks(np.abs(scores) / np.sqrt(strength))


def _parts(column: Floats, label: NDArray[np.intp]) -> sp.csr_array:
    """Cut a ``column`` (n,) into one column for each part (n, parts); ``label`` (n,) is the part of each stride."""
    return sp.csr_array((column, label, np.arange(len(column) + 1)), (len(column), int(label.max()) + 1))


def highest_peaks(values: Floats) -> NDArray[np.intp]:
    """Indices of at most MAX_STEPS peaks of ``values`` (n,), the highest first, at least MIN_STEP_DISTANCE apart."""
    peaks = 1 + np.flatnonzero((values[1:-1] > values[:-2]) & (values[1:-1] > values[2:]))
    is_free, highest = np.ones(len(values), dtype=bool), list[int]()
    for peak in peaks[np.argsort(-values[peaks], kind="stable")].tolist():
        if is_free[peak] and len(highest) < MAX_STEPS:
            highest.append(peak)
            is_free[max(peak - MIN_STEP_DISTANCE + 1, 0) : peak + MIN_STEP_DISTANCE] = False
    return np.array(highest, dtype=np.intp)


def _spans(frame: Frame, on: Mask) -> Spans:
    edges, t = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]]))), frame.strides.t
    return tuple((float(t[a]) - DURATION / 2, float(t[e - 1]) + DURATION / 2) for a, e in edges.reshape(-1, 2).tolist())

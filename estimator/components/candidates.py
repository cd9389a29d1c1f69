"""Candidates of a drive: forms of effects, with signals or fitted times, nameless processes, and stretches of road."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from estimator.components.drive_state import DriveState, has_free_times, slow_noise
from estimator.components.processes import processes, swings, switched
from estimator.components.stretches import STRETCHES, stretches
from estimator.components.switching import Switching
from estimator.components.term import Frame, Term, of_effect, of_term
from estimator.components.time_prior import is_usual, prior_cost, seen
from estimator.estimation.shapes import is_free, near
from estimator.model.effect_term import EffectTerm
from estimator.model.effects.effect import Effect, Timing
from estimator.model.spans import Spans, cut, union, without
from estimator.signals import Floats


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One possible form of a ``cause``, identified among its other forms by ``form``.

    ``is_event``: the cause is specific to its drive; on another drive it counts as another cause.
    """

    cause: str
    is_event: bool
    form: object
    term: Term


@dataclass(frozen=True)
class _Proposed:
    """Times proposed for effects ``beside`` the chosen terms, with the slow noise (2,) of that fit."""

    beside: object
    noise: Floats
    times: set[Spans]

    def is_outdated(self, beside: object, drive: DriveState) -> bool:
        """True if the chosen terms or their times differ, or the slow noise of the drive has halved or doubled."""
        changed = np.abs(np.log2(slow_noise(drive.fit.scales.values) / self.noise))
        return self.beside != beside or bool(changed.max() >= 1.0)


class FoundForms:
    """Times and shapes found by searches on the same drives, by drive number.

    A search from another start, or with another road, reuses them instead of finding them round by round again.
    """

    def __init__(self) -> None:
        self.times: dict[int, set[Spans]] = defaultdict(set)
        self.shapes: dict[int, dict[str, tuple[EffectTerm, float]]] = defaultdict(
            dict
        )  # latest term of an effect, size

    def shape(self, number: int, effect_term: EffectTerm, size: float) -> None:
        """Record a ``effect_term`` with a free shape and its magnitude ``size`` for drive ``number``."""
        self.shapes[number][effect_term.effect.name] = effect_term, size

    def add(self, number: int, drive: DriveState) -> None:
        """Record times and terms of everything chosen on a drive, and the times of its stretches of road."""
        for term, size in zip(drive.chosen, drive.sizes.tolist(), strict=True):
            if term.is_timed and term.spans:
                self.times[number].add(term.spans)
            if term.effect_term is not None:
                self.shape(number, term.effect_term, size)
        if drive.stretches is not None and drive.stretches.spans:
            self.times[number].add(drive.stretches.spans)


class Candidates:
    """Candidates on the drives of one vehicle: ``effects`` of the catalogue, beside the terms ``given`` for each drive.

    Fitted times of effects come from four proposals. Those beside the latest chosen terms are renewed once these or
    their times change, or the slow noise halves or doubles. Those of fits without timed terms and stretches are kept.
    Those that replace all timed terms are renewed with the first stretches of road, and with effects of other names,
    because two effects may share times. Those of earlier searches, in ``forms``, are reused.

    Shapes near those of chosen effects are candidates, and so are shapes near those in ``forms``.
    Otherwise the effect chosen first would have an advantage by its finer shapes alone.
    """

    def __init__(self, effects: Sequence[Effect], given: Sequence[Sequence[Term]], forms: FoundForms) -> None:
        self._effects, self._timed = tuple(effects), [effect for effect in effects if has_free_times(effect)]
        self._given, self._forms = given, forms
        self._latest: dict[int, _Proposed] = {}
        self._untimed: dict[int, set[Spans]] = defaultdict(set)
        self._instead: dict[int, tuple[object, set[Spans]]] = {}
        self._steep: dict[int, set[Spans]] = defaultdict(set)
        self._costs: dict[int, dict[object, float | None]] = defaultdict(dict)

    def on(self, number: int, drive: DriveState, with_processes: bool, with_stretches: bool) -> Iterator[Candidate]:
        """Candidates on the drive with this ``number``; of two equal forms the later one counts.

        ``with_stretches``: include stretches of a road that no signal shows.
        """
        frame, times = Frame.of(drive.fit), self._times(number, drive)
        yield from self._without_fitted_times(frame, drive)
        yield from self._near_shapes(number, frame, drive)
        yield from self._at_times(number, frame, drive.chosen, times)
        if drive.is_hidden and with_stretches:
            yield from self._stretches(number, frame, drive, times)
        if with_processes:
            yield from _nameless(frame, drive, times, len(self._given[number]))

    def _times(self, number: int, drive: DriveState) -> list[Spans]:
        """Times at which effects may act: those of chosen terms, unions of two of these, and the proposed ones."""
        steep = None if drive.stretches is None else drive.stretches.spans
        beside = (*((effect_term.effect.name, effect_term.spans) for effect_term in drive.fit.terms), steep)
        if number not in self._latest or self._latest[number].is_outdated(beside, drive):
            switching, timed = Switching(drive.joint), [*self._timed, *([STRETCHES] if drive.is_hidden else [])]
            times = set[Spans]().union(*map(switching.proposed, timed))
            self._latest[number] = _Proposed(beside, slow_noise(drive.fit.scales.values), times)
            if steep is None and not any(term.is_timed for term in drive.chosen):
                self._untimed[number] |= times
            names = frozenset(term.name for term in drive.chosen), steep is None
            if number not in self._instead or self._instead[number][0] != names:
                self._instead[number] = names, set().union(*map(switching.proposed_instead, timed))
        present = [term.spans for term in drive.chosen if term.is_timed and term.spans]
        present += [] if steep is None else [steep]
        both = {union(a, b) for a, b in combinations(present, 2)}
        proposed = self._latest[number].times | self._instead[number][1] | self._untimed[number]
        proposed |= self._forms.times[number]
        return _different({*present, *both, *proposed}, present, drive.fit.strides.t)

    def _without_fitted_times(self, frame: Frame, drive: DriveState) -> Iterator[Candidate]:
        """Effects that act always, that a signal shows, or that begin at a standstill."""
        quantities = frozenset(drive.strides.context)
        for effect in self._effects:
            for term in of_effect(frame, effect, quantities):
                effect_term = term.effect_term
                assert effect_term is not None
                yield Candidate(
                    cause=effect.name,
                    is_event=effect.timing is not Timing.ALWAYS,
                    form=effect_term.spans or str(effect_term.shape),
                    term=term,
                )

    def _near_shapes(self, number: int, frame: Frame, drive: DriveState) -> Iterator[Candidate]:
        """Shapes near those of chosen effects and of effects found before; given effects keep their shapes."""
        chosen = [
            (c.effect_term, size) for c, size in zip(drive.chosen, drive.sizes.tolist(), strict=True) if c.effect_term
        ]
        present = {effect_term.effect.name: (effect_term, size) for effect_term, size in chosen}
        for effect_term, size in (self._forms.shapes[number] | present).values():
            if not is_free(effect_term) or effect_term.effect not in self._effects:
                continue
            for finer in near(effect_term, size):
                effect, term = effect_term.effect, of_term(frame, finer)
                # Finer shapes depend on the size, which differs between drives: the key is the coarse shape.
                shape = finer.shape if finer.shape in effect.shapes else effect.shape_key(finer.shape)
                yield Candidate(cause=effect.name, is_event=False, form=str(shape), term=term)

    def _at_times(
        self, number: int, frame: Frame, chosen: Sequence[Term], times: Sequence[Spans]
    ) -> Iterator[Candidate]:
        """Effects at fitted times, and at the times of chosen effects with other times added or subtracted."""
        last_costs = self._costs[number]  # costs of the last round: most times recur
        costs = self._costs[number] = {}
        for effect in self._timed:
            present = [c.spans for c in chosen if c.name == effect.name and c.is_timed and c.spans]
            changed = {change(spans, other) for spans in present for other in times for change in (union, without)}
            for spans in _different({*times, *changed}, present, frame.strides.t):
                key = effect.timing, effect.dwell_times, spans  # many effects share dwells
                if key not in costs:
                    costs[key] = last_costs[key] if key in last_costs else _cost(spans, effect, frame.strides.t)
                cost = costs[key]
                if cost is not None:
                    term = of_term(frame, EffectTerm(effect, None, spans), cost)
                    yield Candidate(cause=effect.name, is_event=True, form=spans, term=term)

    def _stretches(self, number: int, frame: Frame, drive: DriveState, times: Sequence[Spans]) -> Iterator[Candidate]:
        """Stretches of the road at fitted times, and at all times of stretches chosen so far.

        The times of the latest chosen stretches are also united with, reduced by and cut at the proposed times.
        """
        present, changed = None if drive.stretches is None else drive.stretches.spans, set[Spans]()
        if present:
            self._steep[number].add(present)
            changed = {change(present, new) for new in self._latest[number].times for change in (union, without, cut)}
        for spans in _different(
            {*times, *changed, *self._steep[number]}, [present] if present else [], frame.strides.t
        ):
            for term in stretches(frame, spans):
                yield Candidate(cause=term.name, is_event=True, form=spans, term=term)


def _different(times: Set[Spans], preferred: Sequence[Spans], t: Floats) -> list[Spans]:
    """Sorted times that differ on the strides at ``t`` (n,) [s]; the term's ``preferred`` times take precedence.

    Times that differ only within gaps have the same column and would be counted several times.
    """
    alike = {seen(spans, t): spans for spans in [*sorted(times), *preferred]}
    return sorted(alike.values())


def _cost(spans: Spans, effect: Effect, t: Floats) -> float | None:
    """Prior cost [nats] of the times of an effect on strides at ``t`` (n,) [s]; None if they are not usual."""
    return prior_cost(spans, effect, t) if is_usual(spans, effect, t) else None


def _nameless(frame: Frame, drive: DriveState, times: Sequence[Spans], given: int) -> Iterator[Candidate]:
    """Nameless processes; ``given`` is the number of given terms of the drive."""
    for spans in times:
        for process in switched(frame, spans):
            yield Candidate(cause=process.name, is_event=True, form=spans, term=process)
    number: Counter[str] = Counter()  # forms of each process so far; they are the same on all drives
    for process in processes(frame):
        yield Candidate(cause=process.name, is_event=False, form=number[process.name], term=process)
        number[process.name] += 1
    beside = [list(range(count)) for count in sorted({given, len(drive.chosen)})]
    for i, process in enumerate(swings(drive.joint, beside)):
        yield Candidate(cause=process.name, is_event=True, form=i, term=process)

"""What may act on a drive: effects in all their forms, with signals or with times, and nameless processes."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from estimator.components.component import Component, Frame, of_effect, of_term
from estimator.components.drive_state import DriveState, has_free_times, slow_noise
from estimator.components.processes import processes, swings, switched
from estimator.components.stretches import STRETCHES, stretches
from estimator.components.switching import Switching
from estimator.components.time_prior import is_usual, prior_cost, seen
from estimator.estimation.shapes import is_free, near
from estimator.model.effects.effect import Effect, Timing
from estimator.model.spans import Spans, cut, union, without
from estimator.model.term import Term
from estimator.signals import Floats


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """One form of a ``cause``, told from its others by ``form``; ``is_event``: on another drive it is another cause."""

    cause: str
    is_event: bool
    form: object
    component: Component


@dataclass(frozen=True)
class _Proposed:
    """Times that effects may have ``beside`` what was chosen, with the slow noise (2,) of that fit."""

    beside: object
    noise: Floats
    times: set[Spans]

    def is_outdated(self, beside: object, drive: DriveState) -> bool:
        """Whether other causes are chosen on the drive, or its slow noise has halved or doubled."""
        changed = np.abs(np.log2(slow_noise(drive.fit.scales.values) / self.noise))
        return self.beside != beside or bool(changed.max() >= 1.0)


class FoundForms:
    """Times and shapes that searches on the same drives have found, for each drive by its number.

    A search from another start, or beside another road, need not find them round by round again.
    """

    def __init__(self) -> None:
        self.times: dict[int, set[Spans]] = defaultdict(set)
        self.shapes: dict[int, dict[str, tuple[Term, float]]] = defaultdict(dict)  # the last of an effect; its size

    def shape(self, number: int, term: Term, size: float) -> None:
        """An effect with this ``term`` may have this ``size``."""
        self.shapes[number][term.effect.name] = term, size

    def add(self, number: int, drive: DriveState) -> None:
        """The forms of all that was chosen on a drive, and stretches of its road."""
        for one, size in zip(drive.chosen, drive.sizes.tolist(), strict=True):
            if one.is_timed and one.spans:
                self.times[number].add(one.spans)
            if one.term is not None:
                self.shape(number, one.term, size)
        if drive.stretches is not None and drive.stretches.spans:
            self.times[number].add(drive.stretches.spans)


class Candidates:
    """All that may act on the drives of a vehicle, for ``effects`` of the catalogue, beside those ``given`` for each.

    An effect's times are those proposed beside the effects chosen last, anew once other ones are chosen, their times
    have changed, or the slow noise has halved or doubled, and those beside none with times nor stretches of the road.
    Two effects may share the times that one of them has, so those in the place of all effects with times are proposed
    too, whenever effects of other names are chosen, or the first stretches of the road.

    Effects that were chosen have shapes near theirs, and so have those ``found`` before: what was chosen first would
    else gain by that alone.
    """

    def __init__(self, effects: Sequence[Effect], given: Sequence[Sequence[Component]], found: FoundForms) -> None:
        self._effects, self._timed = tuple(effects), [effect for effect in effects if has_free_times(effect)]
        self._given, self._found = given, found
        self._latest: dict[int, _Proposed] = {}
        self._untimed: dict[int, set[Spans]] = defaultdict(set)
        self._instead: dict[int, tuple[object, set[Spans]]] = {}
        self._steep: dict[int, set[Spans]] = defaultdict(set)
        self._costs: dict[int, dict[object, float | None]] = defaultdict(dict)

    def on(self, number: int, drive: DriveState, with_processes: bool, with_stretches: bool) -> Iterator[Candidate]:
        """On the drive with this ``number``; of two equal forms the later one counts.

        ``with_stretches``: of a road that no signal shows.
        """
        frame, times = Frame.of(drive.fit), self._times(number, drive)
        yield from self._as_the_bus_tells(frame, drive)
        yield from self._finer(number, frame, drive)
        yield from self._at_times(number, frame, drive.chosen, times)
        if drive.is_hidden and with_stretches:
            yield from self._stretches(number, frame, drive, times)
        if with_processes:
            yield from _nameless(frame, drive, times, len(self._given[number]))

    def _times(self, number: int, drive: DriveState) -> list[Spans]:
        """At which effects may act; what two of those chosen do, one may do."""
        steep = None if drive.stretches is None else drive.stretches.spans
        beside = (*((term.effect.name, term.spans) for term in drive.fit.terms), steep)
        if number not in self._latest or self._latest[number].is_outdated(beside, drive):
            switching, timed = Switching(drive.joint), [*self._timed, *([STRETCHES] if drive.is_hidden else [])]
            times = set[Spans]().union(*map(switching.proposed, timed))
            self._latest[number] = _Proposed(beside, slow_noise(drive.fit.scales.values), times)
            if steep is None and not any(component.is_timed for component in drive.chosen):
                self._untimed[number] |= times
            names = frozenset(component.name for component in drive.chosen), steep is None
            if number not in self._instead or self._instead[number][0] != names:
                self._instead[number] = names, set().union(*map(switching.proposed_instead, timed))
        own = [component.spans for component in drive.chosen if component.is_timed and component.spans]
        own += [] if steep is None else [steep]
        both = {union(a, b) for a, b in combinations(own, 2)}
        proposed = self._latest[number].times | self._instead[number][1] | self._untimed[number]
        proposed |= self._found.times[number]
        return _different({*own, *both, *proposed}, own, drive.fit.strides.t)

    def _as_the_bus_tells(self, frame: Frame, drive: DriveState) -> Iterator[Candidate]:
        """Effects that act always, or when signals show it."""
        known = frozenset(drive.strides.context)
        for effect in self._effects:
            for component in of_effect(frame, effect, known):
                term = component.term
                assert term is not None
                yield Candidate(
                    cause=effect.name,
                    is_event=effect.timing is not Timing.ALWAYS,
                    form=term.spans or str(term.shape),
                    component=component,
                )

    def _finer(self, number: int, frame: Frame, drive: DriveState) -> Iterator[Candidate]:
        """Shapes near those that were chosen and those found before; effects that are given keep theirs."""
        chosen = [(one.term, size) for one, size in zip(drive.chosen, drive.sizes.tolist(), strict=True) if one.term]
        own = {term.effect.name: (term, size) for term, size in chosen}
        for term, size in (self._found.shapes[number] | own).values():
            if not is_free(term) or term.effect not in self._effects:
                continue
            for finer in near(term, size):
                effect, component = term.effect, of_term(frame, finer)
                # Of several drives each may have a size of its own.
                shape = finer.shape if finer.shape in effect.shapes else effect.alike(finer.shape)
                yield Candidate(cause=effect.name, is_event=False, form=str(shape), component=component)

    def _at_times(
        self, number: int, frame: Frame, chosen: Sequence[Component], times: Sequence[Spans]
    ) -> Iterator[Candidate]:
        """Effects at fitted times, and at those that were chosen for them with others added or taken away."""
        before = self._costs[number]  # of the last round: most times come again
        costs = self._costs[number] = {}
        for effect in self._timed:
            own = [c.spans for c in chosen if c.name == effect.name and c.is_timed and c.spans]
            changed = {change(spans, other) for spans in own for other in times for change in (union, without)}
            for spans in _different({*times, *changed}, own, frame.strides.t):
                key = effect.timing, effect.dwells, spans  # many effects have the same dwells
                if key not in costs:
                    costs[key] = before[key] if key in before else _cost(spans, effect, frame.strides.t)
                cost = costs[key]
                if cost is not None:
                    component = of_term(frame, Term(effect, None, spans), cost)
                    yield Candidate(cause=effect.name, is_event=True, form=spans, component=component)

    def _stretches(self, number: int, frame: Frame, drive: DriveState, times: Sequence[Spans]) -> Iterator[Candidate]:
        """Stretches of the road at fitted times, and at all that were chosen so far.

        The last ones that were chosen have times that are proposed beside them added or taken away.
        """
        own, changed = None if drive.stretches is None else drive.stretches.spans, set[Spans]()
        if own:
            self._steep[number].add(own)
            changed = {change(own, new) for new in self._latest[number].times for change in (union, without, cut)}
        for spans in _different({*times, *changed, *self._steep[number]}, [own] if own else [], frame.strides.t):
            for component in stretches(frame, spans):
                yield Candidate(cause=component.name, is_event=True, form=spans, component=component)


def _different(times: Set[Spans], own: Sequence[Spans], t: Floats) -> list[Spans]:
    """Times, in order, that do not look the same on a drive with strides at ``t`` (n,) [s]; its ``own`` ones stay.

    What differs in gaps alone looks the same, and would count as many times.
    """
    alike = {seen(spans, t): spans for spans in [*sorted(times), *own]}
    return sorted(alike.values())


def _cost(spans: Spans, effect: Effect, t: Floats) -> float | None:
    """Of times of an effect on a drive with strides at ``t`` (n,) [s]; None where they are not usual."""
    return prior_cost(spans, effect, t) if is_usual(spans, effect, t) else None


def _nameless(frame: Frame, drive: DriveState, times: Sequence[Spans], given: int) -> Iterator[Candidate]:
    """Processes without a name."""
    for spans in times:
        for process in switched(frame, spans):
            yield Candidate(cause=process.name, is_event=True, form=spans, component=process)
    number: Counter[str] = Counter()  # of the forms of each, which are the same on all drives
    for process in processes(frame):
        yield Candidate(cause=process.name, is_event=False, form=number[process.name], component=process)
        number[process.name] += 1
    beside = [list(range(count)) for count in sorted({given, len(drive.chosen)})]
    for i, process in enumerate(swings(drive.joint, beside)):
        yield Candidate(cause=process.name, is_event=True, form=i, component=process)

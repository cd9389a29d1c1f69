"""Propose candidate terms of a drive: effects with signals or fitted times, nameless processes, stretches of road."""

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence, Set
from dataclasses import dataclass
from itertools import combinations

from estimator.components.drive_state import DriveState, has_free_times
from estimator.components.processes import processes, swings, switched
from estimator.components.stretches import STRETCHES, stretches
from estimator.components.switching import Switching
from estimator.components.term import Frame, Term, term_of, untimed_terms
from estimator.components.time_prior import is_usual, observed_spans, prior_cost
from estimator.estimation.shapes import is_free, near
from estimator.model.effect_term import EffectTerm
from estimator.model.effects.effect import Effect, Timing
from estimator.model.spans import Spans, cut, union, without
from estimator.signals import Floats


@dataclass(frozen=True, kw_only=True)
class CandidateTerm:
    """A ``term`` that may act; ``key`` identifies it among the terms of the same effect or process.

    ``is_event``: it is specific to its drive; on another drive it counts as another effect or process.
    """

    term: Term
    key: object
    is_event: bool


class EarlierTerms:
    """Times and shapes of terms found by earlier searches on the same drives, by drive number.

    A search from another start, or with another road, reuses them instead of finding them round by round again.
    """

    def __init__(self) -> None:
        self.times: dict[int, set[Spans]] = defaultdict(set)
        # Latest term of each effect, by its name, and its magnitude.
        self.effect_terms: dict[int, dict[str, tuple[EffectTerm, float]]] = defaultdict(dict)

    def add_effect_term(self, number: int, effect_term: EffectTerm, magnitude: float) -> None:
        """Record an ``effect_term`` with a free shape and its ``magnitude`` for drive ``number``."""
        self.effect_terms[number][effect_term.effect.name] = effect_term, magnitude

    def add_drive(self, number: int, drive: DriveState) -> None:
        """Record times and terms of everything chosen on a drive, and the times of its stretches of road."""
        for term, magnitude in zip(drive.chosen, drive.magnitudes.tolist(), strict=True):
            if term.is_timed and term.spans:
                self.times[number].add(term.spans)
            if term.effect_term is not None:
                self.add_effect_term(number, term.effect_term, magnitude)
        if drive.stretches is not None and drive.stretches.spans:
            self.times[number].add(drive.stretches.spans)


class CandidateTerms:
    """Candidate terms on the drives of one vehicle: of ``effects``, beside the terms ``given`` for each drive.

    Fitted times of effects are proposed beside the latest chosen terms, and for two chosen effects together, between
    which runs may pass. These are renewed once the chosen terms or their times change. Those of fits without timed
    terms and stretches are kept. Those of earlier searches, in ``earlier_terms``, are reused.

    Shapes near those of chosen effects are candidates, and so are shapes near those in ``earlier_terms``.
    Otherwise the effect chosen first would have an advantage by its finer shapes alone.
    """

    def __init__(self, effects: Sequence[Effect], given: Sequence[Sequence[Term]], earlier_terms: EarlierTerms) -> None:
        self._effects, self._timed = tuple(effects), [effect for effect in effects if has_free_times(effect)]
        self._given, self._earlier_terms = given, earlier_terms
        # Best times of two chosen effects together, by name, for each pair on the drive of a number.
        self.pairs: dict[int, list[dict[str, Spans]]] = defaultdict(list)
        self._latest: dict[int, tuple[object, set[Spans]]] = {}  # chosen terms, and times proposed beside them
        self._untimed: dict[int, set[Spans]] = defaultdict(set)
        self._costs: dict[int, dict[object, float | None]] = defaultdict(dict)

    def on_drive(
        self, number: int, drive: DriveState, with_processes: bool, with_stretches: bool
    ) -> Iterator[CandidateTerm]:
        """Candidate terms on the drive with this ``number``; of two with equal keys the later one counts.

        ``with_stretches``: include stretches of a road that no signal shows.
        """
        frame, times = Frame.of(drive.fit), self._times(number, drive)
        yield from self._without_fitted_times(frame, drive)
        yield from self._near_shapes(number, frame, drive)
        yield from self._at_times(number, frame, drive.chosen, times)
        if drive.is_road_hidden and with_stretches:
            yield from self._stretches(number, frame, drive, times)
        if with_processes:
            yield from _nameless(frame, drive, times, len(self._given[number]))

    def _times(self, number: int, drive: DriveState) -> list[Spans]:
        """Times at which effects may act: those of chosen terms, and the proposed ones."""
        steep = None if drive.stretches is None else drive.stretches.spans
        chosen = (*((effect_term.effect.name, effect_term.spans) for effect_term in drive.fit.terms), steep)
        if number not in self._latest or self._latest[number][0] != chosen:
            switching, timed = Switching(drive.joint), [*self._timed, *([STRETCHES] if drive.is_road_hidden else [])]
            times = set[Spans]().union(*map(switching.proposed, timed))
            if steep is None and not any(term.is_timed for term in drive.chosen):
                self._untimed[number] |= times
            acting = [effect for effect in self._timed if any(term.name == effect.name for term in drive.chosen)]
            self.pairs[number] = list(map(switching.best_pair, combinations(acting, 2)))
            self._latest[number] = chosen, times
        present = [term.spans for term in drive.chosen if term.is_timed and term.spans]
        present += [] if steep is None else [steep]
        proposed = self._latest[number][1] | self._untimed[number] | self._earlier_terms.times[number]
        preferred = [*(spans for pair in self.pairs[number] for spans in pair.values() if spans), *present]
        return _different({*preferred, *proposed}, preferred, drive.fit.strides.t)

    def _without_fitted_times(self, frame: Frame, drive: DriveState) -> Iterator[CandidateTerm]:
        """Effects that act always, that a signal shows, or that begin at a standstill."""
        quantities = frozenset(drive.strides.context)
        for effect in self._effects:
            for term in untimed_terms(frame, effect, quantities):
                effect_term = term.effect_term
                assert effect_term is not None
                key = effect_term.spans or str(effect_term.shape)
                yield CandidateTerm(term=term, key=key, is_event=effect.timing is not Timing.ALWAYS)

    def _near_shapes(self, number: int, frame: Frame, drive: DriveState) -> Iterator[CandidateTerm]:
        """Shapes near those of chosen effects and of effects found before; given effects keep their shapes."""
        chosen = zip(drive.chosen, drive.magnitudes.tolist(), strict=True)
        present = {term.name: (term.effect_term, magnitude) for term, magnitude in chosen if term.effect_term}
        for effect_term, magnitude in (self._earlier_terms.effect_terms[number] | present).values():
            if not is_free(effect_term) or effect_term.effect not in self._effects:
                continue
            for finer in near(effect_term, magnitude):
                effect, term = effect_term.effect, term_of(frame, finer)
                # Finer shapes depend on the size, which differs between drives: the key is the coarse shape.
                shape = finer.shape if finer.shape in effect.shapes else effect.shape_key(finer.shape)
                yield CandidateTerm(term=term, key=str(shape), is_event=False)

    def _at_times(
        self, number: int, frame: Frame, chosen: Sequence[Term], times: Sequence[Spans]
    ) -> Iterator[CandidateTerm]:
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
                    term = term_of(frame, EffectTerm(effect, None, spans), cost)
                    yield CandidateTerm(term=term, key=spans, is_event=True)

    def _stretches(
        self, number: int, frame: Frame, drive: DriveState, times: Sequence[Spans]
    ) -> Iterator[CandidateTerm]:
        """Stretches of the road at fitted times; those chosen last also united with, reduced by and cut at these."""
        present, changed = None if drive.stretches is None else drive.stretches.spans, set[Spans]()
        if present:
            changed = {change(present, new) for new in self._latest[number][1] for change in (union, without, cut)}
        for spans in _different({*times, *changed}, [present] if present else [], frame.strides.t):
            for term in stretches(frame, spans):
                yield CandidateTerm(term=term, key=spans, is_event=True)


def _different(times: Set[Spans], preferred: Sequence[Spans], t: Floats) -> list[Spans]:
    """Sorted times that differ on the strides at ``t`` (n,) [s]; the term's ``preferred`` times take precedence.

    Times that differ only within gaps have the same column and would be counted several times.
    """
    alike = {observed_spans(spans, t): spans for spans in [*sorted(times), *preferred]}
    return sorted(alike.values())


def _cost(spans: Spans, effect: Effect, t: Floats) -> float | None:
    """Prior cost [nats] of the times of an effect on strides at ``t`` (n,) [s]; None if they are not usual."""
    return prior_cost(spans, effect, t) if is_usual(spans, effect, t) else None


def _nameless(frame: Frame, drive: DriveState, times: Sequence[Spans], given: int) -> Iterator[CandidateTerm]:
    """Nameless processes; ``given`` is the number of given terms of the drive."""
    for spans in times:
        for process in switched(frame, spans):
            yield CandidateTerm(term=process, key=spans, is_event=True)
    number: Counter[str] = Counter()  # terms of each process so far; they are the same on all drives
    for process in processes(frame):
        yield CandidateTerm(term=process, key=number[process.name], is_event=False)
        number[process.name] += 1
    hypotheses = [list(range(count)) for count in sorted({given, len(drive.chosen)})]
    for i, process in enumerate(swings(drive.joint, hypotheses)):
        yield CandidateTerm(term=process, key=i, is_event=True)

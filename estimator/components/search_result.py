"""State the result of a search: effects that act on the drives, their probabilities, and nameless processes."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from estimator.components.drive_state import DriveState, FittedTerm
from estimator.components.hypothesis_space import MIN_GAIN, HypothesisSpace, OtherHypotheses
from estimator.components.model_table import Hypothesis, ModelTable, TermGroup
from estimator.components.processes import LOW_PASS
from estimator.components.term import Kind, Term
from estimator.model.effects.effect import Effect, Timing


@dataclass(frozen=True)
class RankedEffect:
    """An effect and its term with most evidence on each drive, None where it cannot be tested."""

    effect: Effect
    term_by_drive: tuple[FittedTerm | None, ...]

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.effect.name

    @property
    def is_event(self) -> bool:
        """True if it may act on one drive and not on another."""
        return self.effect.timing is not Timing.ALWAYS

    @property
    def gain(self) -> float:
        """Log Bayes factor over all drives; the largest one of a drive if the effect is an event."""
        gains = [fitted.gain for fitted in self.term_by_drive if fitted is not None]
        return max(gains) if self.is_event else sum(gains)

    @property
    def best(self) -> tuple[int, FittedTerm]:
        """Number of the drive with most evidence, and the term there."""
        tested = [(number, fitted) for number, fitted in enumerate(self.term_by_drive) if fitted is not None]
        return max(tested, key=lambda pair: pair[1].gain)


@dataclass(frozen=True, kw_only=True)
class ChosenEffect:
    """An effect of the chosen hypothesis.

    ``log_bayes_factor``: given all other terms of the hypothesis. ``drive``: number of the longest drive that it acts
    on. ``rival``: another effect that likely (p > 0.5) acts if this one does not, empty if there is none.
    ``probability_with_rival``: probability that one of the two acts.
    """

    effect: Effect
    probability: float
    rival: str
    probability_with_rival: float
    log_bayes_factor: float
    drive: int

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.effect.name


@dataclass(frozen=True)
class NamelessProcess:
    """The nameless process with most evidence, by drive number.

    ``log_bayes_factor``: averaged over its terms; ``probability``: that any nameless process considered acts.
    """

    term_by_drive: Mapping[int, Term]
    log_bayes_factor: float
    probability: float


@dataclass(frozen=True, kw_only=True)
class SearchResult:
    """The drives with the terms of the chosen hypothesis, and the evidence for them.

    ``chosen``: the effects of that hypothesis, those with most evidence first. ``ranking``: all effects, each alone;
    ``ranking_beside_chosen``: each in addition to the chosen ones. ``probability`` of all effects by name.
    ``nameless``: processes in addition to the chosen effects; ``low_pass``: only the low-pass of the speed, None where
    it is no candidate; ``beyond_low_pass``: the other processes, in addition to the low-pass too. ``log_bf_effects``
    and ``log_bf_processes``: log Bayes factors of the best hypothesis without any process, and of the best one without
    any effect; ``log_bf_chosen_processes``: of the chosen hypothesis without its effects. ``log_posterior``: log
    evidence of the drives with the chosen hypothesis plus its log prior odds.
    ``other_hypotheses``: what these add to the mean and covariance of the road load, for each drive.

    The kind of road is compared afterwards. ``slopes``: log Bayes factor of a sloping road over a level one; None if
    it is not compared, or the configuration gives the road.
    """

    drives: tuple[DriveState, ...]
    chosen: tuple[ChosenEffect, ...]
    ranking: tuple[RankedEffect, ...]
    ranking_beside_chosen: tuple[RankedEffect, ...]
    probability: Mapping[str, float]
    probability_of_none: float  # that no effect and no process acts
    nameless: NamelessProcess
    beyond_low_pass: NamelessProcess
    log_bf_effects: float
    log_bf_processes: float
    log_bf_chosen_processes: float
    log_posterior: float
    other_hypotheses: tuple[OtherHypotheses, ...]
    low_pass: NamelessProcess | None = None
    is_sloping: bool = False  # the road is a state in the model
    slopes: float | None = None
    is_hilly: bool = False  # the slopes are those of a road

    @property
    def longest_number(self) -> int:
        """Number of the drive with most strides; results that hold for a single drive are taken from it."""
        return max(range(len(self.drives)), key=lambda number: len(self.drives[number].fit.strides))

    @property
    def longest(self) -> DriveState:
        """The drive with most strides."""
        return self.drives[self.longest_number]

    @property
    def error_of_form(self) -> float:
        """Log Bayes factor that errors in the form of the strongest effect may give to one that does not act."""
        return MIN_GAIN * max((chosen.log_bayes_factor for chosen in self.chosen), default=0.0)


def ranked(drives: Sequence[DriveState], effects: Sequence[Effect]) -> tuple[RankedEffect, ...]:
    """Effects that some drive can test and that are not chosen, those with most evidence first."""
    by_drive = [drive.fitted_terms(effects) for drive in drives]
    joined = [RankedEffect(effect, tuple(terms.get(effect.name) for terms in by_drive)) for effect in effects]
    return tuple(sorted((entry for entry in joined if any(entry.term_by_drive)), key=lambda entry: -entry.gain))


def log_evidence(drives: Sequence[DriveState]) -> float:
    """Log evidence of all drives together."""
    return sum(drive.log_evidence for drive in drives)


def search_result(
    space: HypothesisSpace,
    table: ModelTable,
    best: Hypothesis,
    states: tuple[DriveState, ...],
    ranking: tuple[RankedEffect, ...],
    effects: Sequence[Effect],
) -> SearchResult:
    """Result of a ``table`` of hypotheses in a ``space``.

    ``best``: the hypothesis chosen from it; ``states``: the drives fitted with it; ``ranking`` of all ``effects``, each
    alone.
    """
    groups, terms = space.groups(), range(len(space.keys))
    terms_of = {effect.name: [i for i in terms if space.term(i).name == effect.name] for effect in effects}
    acting = [effect for effect in effects if set(terms_of[effect.name]) & set(best)]
    chosen = [_chosen_effect(space, table, best, effect, terms_of) for effect in acting]
    road = [i for i in best if space.kind(i) is Kind.ROAD]
    named = [i for i in best if space.kind(i) is Kind.EFFECT] + road
    of_kind = {kind: {i for i in terms if space.kind(i) is kind} for kind in Kind}
    unnamed = of_kind[Kind.PROCESS]
    low_pass = {i for i in unnamed if space.term(i).name == LOW_PASS}
    none = space.log_evidence(road, check_limits=False)

    def log_bf(hypothesis: Sequence[int]) -> float:
        """Log Bayes factor of a hypothesis; 0 where it is negative."""
        return max(space.log_evidence(hypothesis, check_limits=False) - none, 0.0)

    return SearchResult(
        drives=states,
        chosen=tuple(sorted(chosen, key=lambda effect: -effect.log_bayes_factor)),
        ranking=ranking,
        ranking_beside_chosen=ranked(states, effects) if chosen else ranking,
        probability={name: table.probability_of_any(numbers) for name, numbers in terms_of.items()},
        probability_of_none=1 - table.probability_of_any([*of_kind[Kind.EFFECT], *unnamed]),
        nameless=_nameless(space, table, groups, named, unnamed),
        beyond_low_pass=_nameless(space, table, groups, [*named, *low_pass], unnamed - low_pass),
        log_bf_effects=log_bf(_best_without(unnamed, table)),
        log_bf_processes=log_bf(_best_without(of_kind[Kind.EFFECT], table)),
        log_bf_chosen_processes=log_bf([i for i in best if i not in of_kind[Kind.EFFECT]]),
        log_posterior=log_evidence(states) + space.log_prior(best, groups),
        other_hypotheses=space.other_hypotheses(table, best),
        low_pass=_nameless(space, table, groups, named, low_pass) if low_pass else None,
    )


def _best_without(excluded: Set[int], table: ModelTable) -> Hypothesis:
    """Most probable hypothesis of the table without any of the terms ``excluded``."""
    return next(hypothesis for hypothesis in table.hypotheses if not excluded & set(hypothesis))


def _chosen_effect(
    space: HypothesisSpace, table: ModelTable, best: Hypothesis, effect: Effect, terms_of: Mapping[str, Sequence[int]]
) -> ChosenEffect:
    """An ``effect`` that is in the chosen hypothesis ``best``; ``terms_of``: numbers of the terms by effect."""
    terms = terms_of[effect.name]
    present = [i for i in best if i in terms]
    absent = {name: numbers for name, numbers in terms_of.items() if not set(numbers) & set(best)}
    rival, probability_with_rival = table.rival(terms, absent)
    acting_on = sorted({number for i in present for number in space.by_drive[i]})
    return ChosenEffect(
        effect=effect,
        probability=table.probability_of_any(terms),
        rival=rival,
        probability_with_rival=probability_with_rival,
        log_bayes_factor=space.gain(best, present),
        drive=max(acting_on, key=lambda number: len(space.drives[number].strides)),
    )


def _nameless(
    space: HypothesisSpace, table: ModelTable, groups: Sequence[TermGroup], named: Sequence[int], processes: Set[int]
) -> NamelessProcess:
    """Nameless process with most evidence, among ``processes``, in addition to the terms ``named``."""
    beside = space.log_evidence(named, check_limits=False)
    gains = list[tuple[float, int]]()
    for group in (group for group in groups if group.terms[0] in processes):
        gain = space.log_evidence_with(named, group.terms, check_limits=False) - beside
        gains.append((float(logsumexp(gain)) - group.log_count, group.terms[int(np.argmax(gain))]))
    log_bayes_factor, process = max(gains)
    return NamelessProcess(space.by_drive[process], log_bayes_factor, table.probability_of_any([*processes]))

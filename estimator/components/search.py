"""Which components act: a table of models over effects and nameless processes, beside the scales of road and noise.

Noise whose scale was found without the effects is too large, and hides them. So the table is made in rounds: sets of
one cause more each time, with the scales of road and noise found again beside the most probable set, and times of
effects that switch proposed beside it. An effect of the vehicle has to hold in all drives, so its evidence adds up; an
event is a cause on one drive.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from scipy.special import logsumexp

from estimator.components.component import Component, Frame, of_effect, of_term
from estimator.components.drive_state import DriveState, Form, has_free_times
from estimator.components.model_table import Cause, Chosen, ModelTable, weigh
from estimator.components.processes import processes, swings, switched
from estimator.components.switching import is_usual, prior_cost, proposed_times
from estimator.model.design_matrix import Term, union
from estimator.model.effects.effect import Effect, Timing
from estimator.signals import Quantity

ODDS_OF_EFFECTS = 0.37  # prior odds of all effects together: no effect is e times as probable
ODDS_OF_PROCESSES = 0.05  # the same of all nameless processes
MAX_CAUSES = 5  # in a set
MAX_ROUNDS = 8  # of table and scales, each found beside the other
MIN_ROUND_GAIN = 1.0  # in log evidence, for one round more
MIN_GAIN, MIN_GAIN_TIMED = 0.001, 0.01  # of the log BF of the largest effect: errors of its form have as much

Key = tuple[object, ...]


@dataclass(frozen=True)
class Ranked:
    """An effect over all drives; its form on each, None where it cannot be tested."""

    effect: Effect
    each: tuple[Form | None, ...]

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.effect.name

    @property
    def is_event(self) -> bool:
        """Whether it may act on one drive and not on another."""
        return self.effect.timing is not Timing.ALWAYS

    @property
    def gain(self) -> float:
        """In log evidence of all drives together."""
        gains = [form.gain for form in self.each if form is not None]
        return max(gains) if self.is_event else sum(gains)

    @property
    def best(self) -> tuple[int, Form]:
        """Number of the drive with most evidence, and the form there."""
        found = [(i, form) for i, form in enumerate(self.each) if form is not None]
        return max(found, key=lambda pair: pair[1].gain)


@dataclass(frozen=True, kw_only=True)
class Choice:
    """An effect that acts: how probable, its log Bayes factor beside all others, and the drive that shows it most."""

    effect: Effect
    probability: float
    log_bayes_factor: float
    drive: int

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.effect.name


@dataclass(frozen=True, kw_only=True)
class Explained:
    """The drives with what acts on them, and the evidence for it.

    ``choices``: the effects of the most probable set, those with most evidence first. ``ranking``: all effects, each
    alone; ``beside``: each beside the choices. ``probability`` of all effects by name. ``unnamed``: the nameless
    process with most evidence beside the choices, by the numbers of the drives; ``left_over``: its log Bayes factor;
    ``by_effects`` and ``by_processes``: log Bayes factors of the choices without any process, and of the most probable
    processes without any effect. ``log_evidence`` of the drives with the most probable set.
    """

    drives: tuple[DriveState, ...]
    choices: tuple[Choice, ...]
    ranking: tuple[Ranked, ...]
    beside: tuple[Ranked, ...]
    probability: Mapping[str, float]
    none: float  # probability that nothing acts
    unknown: float  # probability that a nameless process acts
    unnamed: Mapping[int, Component]
    left_over: float
    by_effects: float
    by_processes: float
    log_evidence: float


class _Joint:
    """The likelihood of all drives for sets of causes' forms, and the table of models by it."""

    def __init__(
        self, drives: Sequence[DriveState], given: Sequence[tuple[Component, ...]], effects: Sequence[Effect]
    ) -> None:
        self.drives, self.given = drives, given
        found: dict[Key, dict[int, Component]] = defaultdict(dict)
        for number, drive in enumerate(drives):
            for key, component in _hypotheses(number, drive, effects).items():
                found[key][number] = component
        self.keys, self.each = list(found), list(found.values())
        own = [[each[number] for each in self.each if number in each] for number in range(len(drives))]
        self._joints = [replace(d, chosen=g).joint(c) for d, g, c in zip(drives, given, own, strict=True)]
        count = [len(start) for start in given]
        self._places: list[dict[int, int]] = []
        for each in self.each:
            self._places.append({number: count[number] for number in each})
            for number in each:
                count[number] += 1

    def log_evidence(self, chosen: Sequence[int]) -> float:
        """Of a set of forms; minus infinity for a set with an effect of impossible size. Those given may be any."""
        total = 0.0
        for n, joint in enumerate(self._joints):
            here, given = self._here(chosen, n), len(self.given[n])
            posterior = joint.posterior(here)
            largest = [joint.components[i].largest if i >= given else np.inf for i in here]
            widths = [len(joint.places[i]) for i in here]
            if np.any(np.abs(posterior.mean[joint.base_size :]) > np.repeat(largest, widths)):
                return -np.inf
            total += posterior.log_evidence - sum(joint.components[i].cost for i in here)
        return total

    def unlimited(self, chosen: Sequence[int]) -> float:
        """Log evidence of a set of forms, whatever the sizes are."""
        return sum(joint.log_evidence(self._here(chosen, n)) for n, joint in enumerate(self._joints))

    def _here(self, chosen: Sequence[int], number: int) -> list[int]:
        """Numbers of the components of a set, and those given before them, in the likelihood of one drive."""
        own = [self._places[i][number] for i in chosen if number in self._places[i]]
        return [*range(len(self.given[number])), *own]

    def component(self, i: int) -> Component:
        """One of the components that are form ``i``: they have the same name."""
        return next(iter(self.each[i].values()))

    def causes(self) -> list[Cause]:
        """All forms by the cause that they are of."""
        grouped: dict[Key, list[int]] = defaultdict(list)
        for i, key in enumerate(self.keys):
            grouped[key[:2]].append(i)
        named = {own: self.component(forms[0]).term is not None for own, forms in grouped.items()}
        number = sum(named.values())
        return [
            Cause(
                name=" ".join(map(str, own)),
                is_named=named[own],
                forms=tuple(forms),
                log_odds=float(
                    np.log(ODDS_OF_EFFECTS / number if named[own] else ODDS_OF_PROCESSES / (len(named) - number))
                ),
                log_forms=float(np.log(max(sum(not self.component(i).cost for i in forms), 1))),
            )
            for own, forms in grouped.items()
        ]

    def gain(self, chosen: Chosen, form: int) -> float:
        """Log Bayes factor of one form beside the others of a set, its cost not counted."""
        return self.unlimited(chosen) - self.unlimited([i for i in chosen if i != form])

    def worthwhile(self, chosen: Chosen) -> Chosen:
        """A set without effects that gain less than the largest one's form may be wrong by."""
        gains = {i: self.gain(chosen, i) for i in chosen if self.is_named(i)}
        most = max(gains.values(), default=0.0)
        small = {i for i in gains if gains[i] < most * (MIN_GAIN_TIMED if self.component(i).is_timed else MIN_GAIN)}
        return tuple(i for i in chosen if i not in small)

    def is_named(self, i: int) -> bool:
        """Whether form ``i`` is of an effect."""
        return self.component(i).term is not None

    def parts(self, chosen: Chosen, named: bool) -> tuple[tuple[Component, ...], ...]:
        """The effects in a set, or its nameless processes, for each drive."""
        each = [self.each[i] for i in chosen if self.is_named(i) is named]
        return tuple(tuple(own[n] for own in each if n in own) for n in range(len(self.drives)))

    def fitted(self, chosen: Chosen) -> tuple[DriveState, ...]:
        """The drives with the effects of a set, and scales found beside its processes too."""
        own = zip(self.drives, self.given, self.parts(chosen, True), self.parts(chosen, False), strict=True)
        return tuple(drive.having((*given, *effects), processes) for drive, given, effects, processes in own)


def _hypotheses(number: int, drive: DriveState, effects: Sequence[Effect]) -> dict[Key, Component]:
    """All forms of all causes on a drive; a key begins with the name and, for an event, the drive's ``number``."""
    frame, known = Frame.of(drive.fit), frozenset(drive.strides.context)
    beside, found = drive.joint(), dict[Key, Component]()
    for effect in effects:
        for component in of_effect(frame, effect, known):
            term = component.term
            assert term is not None
            event = number if effect.timing is not Timing.ALWAYS else None
            found[effect.name, event, term.spans or str(term.shape)] = component
    for component in drive.chosen:
        term = component.term
        if term is not None and term.effect.finer is not None and not isinstance(term.shape, Quantity):
            for shape in (term.shape, *term.effect.finer(term.shape)):
                found[term.effect.name, None, str(shape)] = of_term(frame, Term(term.effect, shape))
    free = [effect for effect in effects if has_free_times(effect)]
    times = {spans for effect in free for spans in proposed_times(beside, effect)}
    own = [c.spans for c in drive.chosen if c.is_timed and c.spans]
    times |= {*own, *(union(a, b) for a, b in combinations(own, 2))}  # what two effects do, one may do
    for effect in free:
        for spans in sorted(times):
            if is_usual(spans, effect):
                component = of_term(frame, Term(effect, None, spans), prior_cost(spans, effect))
                found[effect.name, number, spans] = component
    for spans in sorted(times):
        for process in switched(frame, spans):
            found[process.name, number, spans] = process
    for i, process in enumerate(processes(frame)):
        found[process.name, None, i] = process
    for i, process in enumerate(swings(beside, list(range(len(drive.chosen))))):
        found[process.name, number, i] = process
    return found


def ranked(drives: Sequence[DriveState], effects: Sequence[Effect]) -> tuple[Ranked, ...]:
    """All effects that some drive can test and that are not chosen, most evidence first."""
    each = [drive.forms(effects) for drive in drives]
    joined = [Ranked(effect, tuple(found.get(effect.name) for found in each)) for effect in effects]
    return tuple(sorted((one for one in joined if any(one.each)), key=lambda one: -one.gain))


def search(drives: Sequence[DriveState], effects: Sequence[Effect]) -> Explained:
    """Weigh sets of ``effects`` and nameless processes on drives that are one vehicle's.

    A process can hold the place of effects while the noise is fitted beside it. So the noise is first fitted beside
    effects alone, and processes are weighed from there.
    """
    first, given = ranked(drives, effects), [drive.chosen for drive in drives]
    alone = _converged(tuple(drives), given, effects, is_named=True)
    return _explained(_converged(alone.states, given, effects, is_named=False), first, effects)


@dataclass(frozen=True)
class _Converged:
    """The last table, the set chosen from it, and the drives fitted beside that set."""

    joint: _Joint
    table: ModelTable
    chosen: Chosen
    states: tuple[DriveState, ...]


def _converged(
    states: tuple[DriveState, ...], given: Sequence[tuple[Component, ...]], effects: Sequence[Effect], is_named: bool
) -> _Converged:
    """Tables and scales, each found beside the other while that gains; of effects alone where ``is_named``."""
    costs = 0.0
    for size in range(2, MAX_ROUNDS + 2):
        joint = _Joint(states, given, effects)
        causes = [cause for cause in joint.causes() if cause.is_named or not is_named]
        table = weigh(joint, causes, min(size, MAX_CAUSES))
        chosen = table.best
        fitted, before = joint.fitted(chosen), costs
        costs = sum(joint.component(i).cost for i in chosen)
        gained = sum(new.fit.log_evidence - old.fit.log_evidence for new, old in zip(fitted, states, strict=True))
        if len(chosen) < size and gained - (costs - before) < MIN_ROUND_GAIN:
            break
        states = fitted
    best = joint.worthwhile(chosen)
    return _Converged(joint, table, best, fitted if best == chosen else joint.fitted(best))


def _explained(found: _Converged, first: tuple[Ranked, ...], effects: Sequence[Effect]) -> Explained:
    joint, table, best, states = found.joint, found.table, found.chosen, found.states
    causes = joint.causes()
    whole = joint.unlimited(best)
    forms = range(len(joint.keys))
    probability = {e.name: table.holding([i for i in forms if joint.component(i).name == e.name]) for e in effects}
    choices = []
    for effect in effects:
        own = [i for i in best if joint.component(i).name == effect.name]
        if own:
            rest = [i for i in best if i not in own]
            choices.append(
                Choice(
                    effect=effect,
                    probability=probability[effect.name],
                    log_bayes_factor=whole - joint.unlimited(rest),
                    drive=max(joint.each[own[0]], key=lambda n: len(joint.drives[n].strides)),
                )
            )
    named = [i for i in best if joint.component(i).term is not None]
    beside = joint.unlimited(named)
    gains = {
        cause.name: (
            float(logsumexp([joint.unlimited([*named, i]) - beside for i in cause.forms])) - cause.log_forms,
            max(cause.forms, key=lambda i: joint.unlimited([*named, i])),
        )
        for cause in causes
        if not cause.is_named
    }
    left_over, process = max(gains.values())
    unnamed = [i for cause in causes if not cause.is_named for i in cause.forms]
    none = joint.unlimited([])
    alone = [joint.unlimited(own) for own in table.sets if own and set(own) <= set(unnamed)]
    return Explained(
        drives=states,
        choices=tuple(sorted(choices, key=lambda choice: -choice.log_bayes_factor)),
        ranking=first,
        beside=ranked(states, effects) if choices else first,
        probability=probability,
        none=table.none,
        unknown=table.holding(unnamed),
        unnamed=joint.each[process],
        left_over=left_over,
        by_effects=beside - none,
        by_processes=max([0.0, *(value - none for value in alone)]),
        log_evidence=sum(state.fit.log_evidence for state in states),
    )

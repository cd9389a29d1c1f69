"""Which components act: a table of models over effects and nameless processes, beside the scales of road and noise.

Noise whose scale was found without the effects is too large, and hides them. So the table is made in rounds: sets of
one cause more each time, with the scales of road and noise found again beside the most probable set, and times of
effects that switch proposed beside it.
"""

from collections.abc import Mapping, Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import logsumexp

from estimator.components.candidates import Candidates
from estimator.components.component import Component, Kind
from estimator.components.drive_state import DriveState, Form
from estimator.components.hypotheses import Hypotheses, OtherSets
from estimator.components.model_table import MAX_CAUSES, Cause, Chosen, ModelTable, weigh
from estimator.components.processes import LOW_PASS
from estimator.model.effects.effect import Effect, Timing

MAX_ROUNDS = 20  # of table and scales, each found beside the other
MIN_ROUND_GAIN = 1.0  # in log evidence, for one round more
ROUNDING = 1e-6  # of log evidence: by less, a round that finds the same set and scales again differs by rounding alone


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
    """An effect that acts: how probable, its log Bayes factor beside all others, and the drive that shows it most.

    ``rival``: another effect that acts, more likely than not, where this one does not; empty if there is none.
    ``either``: the probability that one of the two acts.
    """

    effect: Effect
    probability: float
    rival: str
    either: float
    log_bayes_factor: float
    drive: int

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.effect.name


@dataclass(frozen=True)
class Nameless:
    """The nameless process with most evidence, by the numbers of the drives, and how probable it is that any acts."""

    processes: Mapping[int, Component]
    log_bayes_factor: float
    probability: float


@dataclass(frozen=True, kw_only=True)
class Explained:
    """The drives with what acts on them, and the evidence for it.

    ``choices``: the effects of the most probable set, those with most evidence first. ``ranking``: all effects, each
    alone; ``beside``: each beside the choices. ``probability`` of all effects by name. ``nameless``: what has no name
    beside the choices; ``beyond_low_pass``: that but a low-pass of the speed, beside this too. ``by_effects`` and
    ``by_processes``: log Bayes factors of the choices without any process, and of the most probable processes without
    any effect. ``log_evidence`` of the drives with the most probable set. ``others``: what less probable sets add to
    the road load of each drive.
    """

    drives: tuple[DriveState, ...]
    choices: tuple[Choice, ...]
    ranking: tuple[Ranked, ...]
    beside: tuple[Ranked, ...]
    probability: Mapping[str, float]
    none: float  # probability that nothing acts
    nameless: Nameless
    beyond_low_pass: Nameless
    by_effects: float
    by_processes: float
    log_evidence: float
    others: tuple[OtherSets, ...]


def ranked(drives: Sequence[DriveState], effects: Sequence[Effect]) -> tuple[Ranked, ...]:
    """All effects that some drive can test and that are not chosen, most evidence first."""
    each = [drive.forms(effects) for drive in drives]
    joined = [Ranked(effect, tuple(found.get(effect.name) for found in each)) for effect in effects]
    return tuple(sorted((one for one in joined if any(one.each)), key=lambda one: -one.gain))


@dataclass(frozen=True)
class _Converged:
    """The last table, the set chosen from it, and the drives fitted beside that set."""

    joint: Hypotheses
    table: ModelTable
    chosen: Chosen
    states: tuple[DriveState, ...]

    @property
    def log_posterior(self) -> float:
        """Log evidence of the set that was chosen, with its prior odds."""
        return log_evidence(self.states) + self.joint.log_prior(self.chosen, self.joint.causes())


class _OutOfReachError(Exception):
    """The log evidence that is asked for will not be reached."""


class Search:
    """A search among sets of ``effects`` and nameless processes, on ``drives`` that are one vehicle's.

    A process can hold the place of effects while the noise is fitted beside it. So the noise is first fitted beside
    effects alone, and processes are weighed from there.

    Parameters
    ----------
    drives
        With the effects that are given.
    effects
        That may act besides.
    """

    def __init__(self, drives: tuple[DriveState, ...], effects: Sequence[Effect]) -> None:
        self._drives, self._effects = drives, effects
        self._given = [drive.chosen for drive in drives]
        self._candidates = Candidates(effects, self._given)

    @cached_property
    def alone(self) -> tuple[DriveState, ...]:
        """The drives fitted beside the most probable effects without any process."""
        return self._alone().states

    def explained(self) -> Explained:
        """The drives with what acts on them."""
        return self._explained(self._converged(self.alone, with_processes=True, with_stretches=True))

    def explained_above(self, least: float) -> Explained | None:
        """The same; None once it shows that the log evidence will not reach ``least``."""
        try:
            alone = self._alone(least)
            return self._explained(self._converged(alone.states, with_processes=True, with_stretches=True, least=least))
        except _OutOfReachError:
            return None

    def _explained(self, found: _Converged) -> Explained:
        return _explained(found, ranked(self._drives, self._effects), self._effects)

    def _alone(self, least: float = -np.inf) -> _Converged:
        """Beside effects alone, from the noise of the drives, and from the usual one where theirs is larger.

        Over a road that no signal shows, its stretches come before the effects or after them: either may hold the place
        of the other.

        Raises
        ------
        _OutOfReachError
            Neither would reach ``least``.
        """
        found = self._from(self._drives, least)
        if any(drive.has_unusual_noise for drive in self._drives):
            found += self._from(tuple(drive.with_usual_noise() for drive in self._drives), least)
        if not found:
            raise _OutOfReachError
        return max(found, key=lambda one: one.log_posterior)

    def _from(self, start: tuple[DriveState, ...], least: float) -> list[_Converged]:
        """What the search among effects alone comes to from one start; nothing where that will not reach ``least``."""
        found = list[_Converged]()
        with suppress(_OutOfReachError):
            found.append(self._converged(start, least=least))
            if any(drive.is_hidden for drive in start):
                found += [self._converged(first, with_stretches=True) for first in (found[-1].states, start)]
        return found

    def _converged(
        self,
        states: tuple[DriveState, ...],
        with_processes: bool = False,
        with_stretches: bool = False,
        least: float = -np.inf,
    ) -> _Converged:
        """Tables and scales, each found beside the other while that gains.

        A set that is best with the scales found beside another one may have less evidence with its own, and sizes that
        are impossible for the vehicle as it is found then: the next table goes on from there without that set.

        Raises
        ------
        _OutOfReachError
            As many rounds as a set has causes, each with the gain of the last, would not reach ``least``.
        """
        found, last, value = None, None, log_evidence(states)
        for size in range(2, MAX_ROUNDS + 2):
            candidates = [
                self._candidates.on(number, state, with_processes, with_stretches)
                for number, state in enumerate(states)
            ]
            joint = Hypotheses(states, self._given, candidates)
            causes = joint.causes()
            before = joint.before() if with_processes else ()  # processes come to the effects found without them
            room = max(size, len(before) + 1)
            table = weigh(joint, causes, min(room, MAX_CAUSES), before)
            fitted = joint.fitted(table.best)
            if log_evidence(fitted) + MAX_CAUSES * max(log_evidence(fitted) - log_evidence(states), 0.0) < least:
                raise _OutOfReachError
            gain = log_evidence(fitted) + joint.log_prior(table.best, causes) - value
            if found is not None and gain < -ROUNDING:
                break
            last, states = _Converged(joint, table, table.best, fitted), fitted
            for number, term, magnitude in joint.rivals(table):
                self._candidates.rival(number, term, magnitude)
            if all(state.is_possible(len(given)) for state, given in zip(states, self._given, strict=True)):
                found, value = last, value + gain
                if len(table.best) < room and gain < MIN_ROUND_GAIN:
                    break
        found = found or last
        assert found is not None
        best = found.joint.worthwhile(found.chosen)
        return found if best == found.chosen else replace(found, chosen=best, states=found.joint.fitted(best))


def log_evidence(drives: Sequence[DriveState]) -> float:
    """Of all drives together."""
    return sum(drive.fit.log_evidence for drive in drives)


def _explained(found: _Converged, first: tuple[Ranked, ...], effects: Sequence[Effect]) -> Explained:
    joint, table, best, states = found.joint, found.table, found.chosen, found.states
    causes = joint.causes()
    whole = joint.unlimited(best)
    forms = range(len(joint.keys))
    forms_of = {effect.name: [i for i in forms if joint.component(i).name == effect.name] for effect in effects}
    probability = {name: table.holding(own) for name, own in forms_of.items()}
    absent = [name for name, own in forms_of.items() if not set(own) & set(best)]
    choices = []
    for effect in effects:
        own = set(best) & set(forms_of[effect.name])
        if own:
            rest = [i for i in best if i not in own]
            rival, either = table.rival(forms_of[effect.name], {name: forms_of[name] for name in absent})
            choices.append(
                Choice(
                    effect=effect,
                    probability=probability[effect.name],
                    rival=rival,
                    either=either,
                    log_bayes_factor=whole - joint.unlimited(rest),
                    drive=max(joint.each[min(own)], key=lambda n: len(joint.drives[n].strides)),
                )
            )
    road = [i for i in best if joint.kind(i) is Kind.ROAD]
    named = [i for i in best if joint.kind(i) is Kind.EFFECT] + road
    beside = joint.unlimited(named)
    of_kind = {kind: {i for i in forms if joint.kind(i) is kind} for kind in Kind}
    unnamed = of_kind[Kind.PROCESS]
    low_pass = {i for i in unnamed if joint.component(i).name == LOW_PASS}
    none = joint.unlimited(road)
    alone = [joint.unlimited(own) for own in table.sets if unnamed & set(own) and not of_kind[Kind.EFFECT] & set(own)]
    return Explained(
        drives=states,
        choices=tuple(sorted(choices, key=lambda choice: -choice.log_bayes_factor)),
        ranking=first,
        beside=ranked(states, effects) if choices else first,
        probability=probability,
        none=1 - table.holding([*of_kind[Kind.EFFECT], *unnamed]),
        nameless=_nameless(joint, table, causes, named, unnamed),
        beyond_low_pass=_nameless(joint, table, causes, [*named, *low_pass], unnamed - low_pass),
        by_effects=beside - none,
        by_processes=max([0.0, *(value - none for value in alone)]),
        log_evidence=log_evidence(states),
        others=joint.others(table, best),
    )


def _nameless(
    joint: Hypotheses, table: ModelTable, causes: Sequence[Cause], named: Sequence[int], forms: Set[int]
) -> Nameless:
    """Of the processes with these ``forms``, beside ``named`` ones."""
    beside = joint.unlimited(named)
    gains = {
        cause.name: (
            float(logsumexp([joint.unlimited([*named, i]) - beside for i in cause.forms])) - cause.log_forms,
            max(cause.forms, key=lambda i: joint.unlimited([*named, i])),
        )
        for cause in causes
        if cause.forms[0] in forms
    }
    log_bayes_factor, process = max(gains.values())
    return Nameless(joint.each[process], log_bayes_factor, table.holding([*forms]))

"""What a table of models says of drives: which effects act, how probable they are, and what has no name."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from estimator.components.component import Component, Kind
from estimator.components.drive_state import DriveState, Form
from estimator.components.hypotheses import MIN_GAIN, Hypotheses, OtherSets
from estimator.components.model_table import Cause, Chosen, ModelTable
from estimator.components.processes import LOW_PASS
from estimator.model.effects.effect import Effect, Timing


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
    """An effect that acts: how probable, its log Bayes factor beside all others, and the longest drive it acts on.

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
    beside the choices; ``beyond_low_pass``: that but a low-pass of the speed, beside this too; ``low_pass``: that
    alone, None where it is no candidate. ``by_effects`` and ``by_processes``: log Bayes factors of the most probable
    effects without any process, and of the most probable processes without any effect. ``log_posterior``: log evidence
    of the drives with the most probable set, and its log prior odds. ``others``: what less probable sets add to the
    road load of each drive.
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
    log_posterior: float
    others: tuple[OtherSets, ...]
    low_pass: Nameless | None = None

    @property
    def error_of_form(self) -> float:
        """Log Bayes factor that errors of the form of the largest choice may give to what does not act."""
        return MIN_GAIN * max((choice.log_bayes_factor for choice in self.choices), default=0.0)


def ranked(drives: Sequence[DriveState], effects: Sequence[Effect]) -> tuple[Ranked, ...]:
    """All effects that some drive can test and that are not chosen, most evidence first."""
    each = [drive.forms(effects) for drive in drives]
    joined = [Ranked(effect, tuple(found.get(effect.name) for found in each)) for effect in effects]
    return tuple(sorted((one for one in joined if any(one.each)), key=lambda one: -one.gain))


def log_evidence(drives: Sequence[DriveState]) -> float:
    """Of all drives together."""
    return sum(drive.log_evidence for drive in drives)


def explained_by(
    joint: Hypotheses,
    table: ModelTable,
    best: Chosen,
    states: tuple[DriveState, ...],
    first: tuple[Ranked, ...],
    effects: Sequence[Effect],
) -> Explained:
    """What a ``table`` of the sets of ``joint`` says.

    ``best``: the set that was chosen from it, and ``states`` the drives fitted beside that; ``first``: the ranking of
    all ``effects``, each alone.
    """
    causes, forms = joint.causes(), range(len(joint.keys))
    forms_of = {effect.name: [i for i in forms if joint.component(i).name == effect.name] for effect in effects}
    acting = [effect for effect in effects if set(forms_of[effect.name]) & set(best)]
    choices = [_choice(joint, table, best, effect, forms_of) for effect in acting]
    road = [i for i in best if joint.kind(i) is Kind.ROAD]
    named = [i for i in best if joint.kind(i) is Kind.EFFECT] + road
    of_kind = {kind: {i for i in forms if joint.kind(i) is kind} for kind in Kind}
    unnamed = of_kind[Kind.PROCESS]
    low_pass = {i for i in unnamed if joint.component(i).name == LOW_PASS}
    none = joint.unlimited(road)

    def without(others: Set[int]) -> float:
        """Log Bayes factor of the most probable set without ``others``; 0 where it is of no use."""
        alone = next(own for own in table.sets if not others & set(own))
        return max(joint.unlimited(alone) - none, 0.0)

    return Explained(
        drives=states,
        choices=tuple(sorted(choices, key=lambda choice: -choice.log_bayes_factor)),
        ranking=first,
        beside=ranked(states, effects) if choices else first,
        probability={name: table.holding(own) for name, own in forms_of.items()},
        none=1 - table.holding([*of_kind[Kind.EFFECT], *unnamed]),
        nameless=_nameless(joint, table, causes, named, unnamed),
        beyond_low_pass=_nameless(joint, table, causes, [*named, *low_pass], unnamed - low_pass),
        by_effects=without(unnamed),
        by_processes=without(of_kind[Kind.EFFECT]),
        log_posterior=log_evidence(states) + joint.log_prior(best, causes),
        others=joint.others(table, best),
        low_pass=_nameless(joint, table, causes, named, low_pass) if low_pass else None,
    )


def _choice(
    joint: Hypotheses, table: ModelTable, best: Chosen, effect: Effect, forms_of: Mapping[str, Sequence[int]]
) -> Choice:
    """Of an ``effect`` in the set that was chosen."""
    forms = forms_of[effect.name]
    own = [i for i in best if i in forms]
    absent = {name: others for name, others in forms_of.items() if not set(others) & set(best)}
    rival, either = table.rival(forms, absent)
    return Choice(
        effect=effect,
        probability=table.holding(forms),
        rival=rival,
        either=either,
        log_bayes_factor=joint.unlimited(best) - joint.unlimited([i for i in best if i not in own]),
        drive=max(sorted({n for i in own for n in joint.each[i]}), key=lambda n: len(joint.drives[n].strides)),
    )


def _nameless(
    joint: Hypotheses, table: ModelTable, causes: Sequence[Cause], named: Sequence[int], forms: Set[int]
) -> Nameless:
    """Of the processes with these ``forms``, beside ``named`` ones."""
    beside = joint.unlimited(named)
    gains = list[tuple[float, int]]()
    for cause in (cause for cause in causes if cause.forms[0] in forms):
        gain = joint.unlimited_with_each(named, cause.forms) - beside
        gains.append((float(logsumexp(gain)) - cause.log_forms, cause.forms[int(np.argmax(gain))]))
    log_bayes_factor, process = max(gains)
    return Nameless(joint.each[process], log_bayes_factor, table.holding([*forms]))

"""Result of a search: effects that act on the drives, their probabilities, and nameless processes."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from estimator.components.drive_state import DriveState, Form
from estimator.components.hypotheses import MIN_GAIN, Hypotheses, OtherSets
from estimator.components.model_table import Cause, Chosen, ModelTable
from estimator.components.processes import LOW_PASS
from estimator.components.term import Kind, Term
from estimator.model.effects.effect import Effect, Timing


@dataclass(frozen=True)
class Ranked:
    """An effect and its best form on each drive, None where it cannot be tested."""

    effect: Effect
    each: tuple[Form | None, ...]

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
        gains = [form.gain for form in self.each if form is not None]
        return max(gains) if self.is_event else sum(gains)

    @property
    def best(self) -> tuple[int, Form]:
        """Number of the drive with most evidence, and the form there."""
        forms = [(i, form) for i, form in enumerate(self.each) if form is not None]
        return max(forms, key=lambda pair: pair[1].gain)


@dataclass(frozen=True, kw_only=True)
class Choice:
    """An effect of the chosen hypothesis.

    ``log_bayes_factor``: given all other terms of the hypothesis. ``drive``: number of the longest drive that it acts
    on. ``rival``: another effect that likely (p > 0.5) acts if this one does not, empty if there is none. ``either``:
    probability that one of the two acts.
    """

    effect: Effect
    probability: float
    rival: str
    either: float
    log_bayes_factor: float
    drive: int

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.effect.name


@dataclass(frozen=True)
class Nameless:
    """The nameless process with most evidence, by drive number.

    ``log_bayes_factor``: averaged over its forms; ``probability``: that any nameless process considered acts.
    """

    processes: Mapping[int, Term]
    log_bayes_factor: float
    probability: float


@dataclass(frozen=True, kw_only=True)
class Explained:
    """Result of a search: the drives with the terms of the chosen hypothesis, and the evidence for them.

    ``choices``: the effects of the chosen hypothesis, those with most evidence first. ``ranking``: all effects, each
    alone; ``beside``: each in addition to the choices. ``probability`` of all effects by name. ``nameless``: processes
    in addition to the choices; ``low_pass``: only the low-pass of the speed, None where it is no candidate;
    ``beyond_low_pass``: the other processes, in addition to the low-pass too. ``by_effects`` and ``by_processes``: log
    Bayes factors of the best hypothesis without any process, and of the best one without any effect. ``log_posterior``:
    log evidence of the drives with the chosen hypothesis plus its log prior odds. ``others``: what other hypotheses add
    to the mean and covariance of the road load, for each drive.
    """

    drives: tuple[DriveState, ...]
    choices: tuple[Choice, ...]
    ranking: tuple[Ranked, ...]
    beside: tuple[Ranked, ...]
    probability: Mapping[str, float]
    none: float  # probability that no effect and no process acts
    nameless: Nameless
    beyond_low_pass: Nameless
    by_effects: float
    by_processes: float
    log_posterior: float
    others: tuple[OtherSets, ...]
    low_pass: Nameless | None = None

    @property
    def error_of_form(self) -> float:
        """Log Bayes factor that errors in the form of the strongest choice may give to an effect that does not act."""
        return MIN_GAIN * max((choice.log_bayes_factor for choice in self.choices), default=0.0)


def ranked(drives: Sequence[DriveState], effects: Sequence[Effect]) -> tuple[Ranked, ...]:
    """Effects that some drive can test and that are not chosen, those with most evidence first."""
    by_drive = [drive.forms(effects) for drive in drives]
    joined = [Ranked(effect, tuple(forms.get(effect.name) for forms in by_drive)) for effect in effects]
    return tuple(sorted((entry for entry in joined if any(entry.each)), key=lambda entry: -entry.gain))


def log_evidence(drives: Sequence[DriveState]) -> float:
    """Log evidence of all drives together."""
    return sum(drive.log_evidence for drive in drives)


def explained_by(
    joint: Hypotheses,
    table: ModelTable,
    best: Chosen,
    states: tuple[DriveState, ...],
    first: tuple[Ranked, ...],
    effects: Sequence[Effect],
) -> Explained:
    """Result of a ``table`` of hypotheses among the forms of ``joint``.

    ``best``: the hypothesis chosen from it; ``states``: the drives fitted with it; ``first``: the ranking of all
    ``effects``, each alone.
    """
    causes, forms = joint.causes(), range(len(joint.keys))
    forms_of = {effect.name: [i for i in forms if joint.term(i).name == effect.name] for effect in effects}
    acting = [effect for effect in effects if set(forms_of[effect.name]) & set(best)]
    choices = [_choice(joint, table, best, effect, forms_of) for effect in acting]
    road = [i for i in best if joint.kind(i) is Kind.ROAD]
    named = [i for i in best if joint.kind(i) is Kind.EFFECT] + road
    of_kind = {kind: {i for i in forms if joint.kind(i) is kind} for kind in Kind}
    unnamed = of_kind[Kind.PROCESS]
    low_pass = {i for i in unnamed if joint.term(i).name == LOW_PASS}
    none = joint.unlimited(road)

    def without(others: Set[int]) -> float:
        """Log Bayes factor of the most probable hypothesis without ``others``; 0 where it is negative."""
        alone = next(forms_of_set for forms_of_set in table.sets if not others & set(forms_of_set))
        return max(joint.unlimited(alone) - none, 0.0)

    return Explained(
        drives=states,
        choices=tuple(sorted(choices, key=lambda choice: -choice.log_bayes_factor)),
        ranking=first,
        beside=ranked(states, effects) if choices else first,
        probability={name: table.holding(forms_of_set) for name, forms_of_set in forms_of.items()},
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
    """Choice of an ``effect`` that is in the chosen hypothesis ``best``."""
    forms = forms_of[effect.name]
    chosen_forms = [i for i in best if i in forms]
    absent = {name: others for name, others in forms_of.items() if not set(others) & set(best)}
    rival, either = table.rival(forms, absent)
    return Choice(
        effect=effect,
        probability=table.holding(forms),
        rival=rival,
        either=either,
        log_bayes_factor=joint.unlimited(best) - joint.unlimited([i for i in best if i not in chosen_forms]),
        drive=max(sorted({n for i in chosen_forms for n in joint.each[i]}), key=lambda n: len(joint.drives[n].strides)),
    )


def _nameless(
    joint: Hypotheses, table: ModelTable, causes: Sequence[Cause], named: Sequence[int], forms: Set[int]
) -> Nameless:
    """Nameless process with most evidence, among ``forms``, in addition to the terms ``named``."""
    beside = joint.unlimited(named)
    gains = list[tuple[float, int]]()
    for cause in (cause for cause in causes if cause.forms[0] in forms):
        gain = joint.unlimited_with_each(named, cause.forms) - beside
        gains.append((float(logsumexp(gain)) - cause.log_forms, cause.forms[int(np.argmax(gain))]))
    log_bayes_factor, process = max(gains)
    return Nameless(joint.each[process], log_bayes_factor, table.holding([*forms]))

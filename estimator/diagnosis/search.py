"""Which effects: the one with most evidence first, those chosen tried again after each, until nothing is left to name.

Several drives of one vehicle are searched together. An effect of the vehicle has to hold in all of them: its evidence
adds up. An event, bounded in time, may be in one drive only.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from estimator.diagnosis.candidates import ALIKE, Candidate, Rest, assess
from estimator.diagnosis.model import Model, fit, select
from estimator.diagnosis.processes import UNMEASURED_GRADE, Leftover, grains_of, leftovers
from estimator.diagnosis.record import Record
from estimator.diagnosis.shrinkage import HeldOut, held_out
from estimator.effects import Effect, Timing
from estimator.estimation.columns import Term, settled
from estimator.units import STANDARD_GRAVITY

NAMED = 5.0  # log Bayes factor over none that names an effect
AHEAD = 3.0  # and over the next that is not of its class
NEXT = 8.0  # of an effect beside another: each one more has to earn its place
NEXT_TIMED = 20.0  # and if its times are free, it fits what the others left not quite right
LEAST, LEAST_TIMED = 0.003, 0.04  # and of what the first took away: no effect has exactly its textbook form
EVIDENT = 15.0  # evidence of a process that says something is there, though nothing has a name
NEAR = 0.8  # of the best evidence: at a steady speed time and place are the same
UNEXPLAINED = 20.0  # evidence of a process, on what is left, beyond which something is there that has no name
TEMPER = 1.5
RARE = 1.0  # log prior odds of none against any
LAPSE = 0.03
FLATTEST = 0.002  # sd of a grade
MOST = 4  # effects that are looked for


@dataclass(frozen=True)
class Drive:
    """One record with its model so far."""

    record: Record
    model: Model

    @property
    def rest(self) -> Rest | None:
        """What idling tells, unless an effect in the model takes power there."""
        taken = any(term.effect.at_rest is not None for term in self.model.terms)
        return None if self.record.idling is None or taken else Rest(*self.record.idling)

    def having(self, terms: tuple[Term, ...]) -> "Drive":
        """The same drive with other effects; the same as before where they cannot be fitted."""
        kept = select(self.record.samples, terms)
        model = None if kept is None else fit(self.record.samples[kept], terms)
        return self if model is None else Drive(self.record, model)

    def without(self, name: str) -> "Drive":
        """The same drive less one effect."""
        return self.having(tuple(term for term in self.model.terms if term.effect.name != name))


@dataclass(frozen=True)
class Joint:
    """One effect over all drives: its candidate in each, None where it cannot be tested there."""

    effect: Effect
    each: tuple[Candidate | None, ...]

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.effect.name

    @property
    def log_bayes_factor(self) -> float:
        """Over all drives."""
        values = [candidate.log_bayes_factor for candidate in self.each if candidate is not None]
        return max(values) if self.is_event else sum(values)

    @property
    def is_event(self) -> bool:
        """Whether it may be there in one drive and not in another."""
        return self.effect.timing is not Timing.ALWAYS

    @property
    def best(self) -> tuple[int, Candidate]:
        """The drive that says most, and what it says."""
        found = [(i, candidate) for i, candidate in enumerate(self.each) if candidate is not None]
        return max(found, key=lambda pair: pair[1].log_bayes_factor)


@dataclass(frozen=True)
class Found:
    """An effect as it was chosen: among which others, and on top of what."""

    joint: Joint
    ranking: tuple[Joint, ...]
    before: tuple[Drive, ...]


@dataclass(frozen=True)
class Search:
    """Where the search ended: what was chosen, the first ranking, processes before and after, the final models."""

    chosen: tuple[Found, ...]
    ranking: tuple[Joint, ...]
    at_first: tuple[Leftover, ...]
    at_last: tuple[Leftover, ...]
    drives: tuple[Drive, ...]


def search(plain: tuple[Drive, ...], effects: Sequence[Effect]) -> Search:
    """Choose effects for the drives."""
    drives, chosen = plain, list[Found]()
    first, most = ranked(plain, effects), 0.0
    at_first = _leftovers(plain)
    if hidden_grade(first, at_first, plain) is not None:
        return Search((), first, at_first, at_first, plain)
    while len(chosen) < MOST:
        ranking = first if not chosen else ranked(drives, effects)
        if not ranking or ranking[0].log_bayes_factor < _needed(ranking[0], len(chosen)):
            break
        grown = _add(drives, ranking[0])
        taken = pooled(drives, grown).mean_square - pooled(grown, grown).mean_square
        if taken <= 0 or (chosen and taken < _share(ranking[0]) * most):
            break
        most = max(taken, most)
        chosen.append(Found(ranking[0], ranking, drives))
        drives = grown
        if len(chosen) > 1:
            chosen, drives = _exchange(plain, chosen, drives, effects)
    return Search(tuple(chosen), first, at_first, _leftovers(drives) if chosen else at_first, drives)


def _needed(joint: Joint, chosen: int) -> float:
    """Log Bayes factor that names an effect beside those already ``chosen``."""
    if not chosen:
        return NAMED
    return NEXT_TIMED if joint.best[1].term.spans is not None else NEXT


def _share(joint: Joint) -> float:
    """Of the squared residual that the largest effect takes away, what one more has to take at least."""
    return LEAST_TIMED if joint.best[1].term.spans is not None else LEAST


def pooled(drives: tuple[Drive, ...], on: tuple[Drive, ...]) -> HeldOut:
    """Held-out residuals of the models of ``drives`` on the samples of others."""
    parts = [held_out(o.model.samples, d.model.terms, d.model.road_load) for d, o in zip(drives, on, strict=True)]
    return HeldOut(np.concatenate([part.squares for part in parts]))


def ranked(drives: tuple[Drive, ...], effects: Sequence[Effect]) -> tuple[Joint, ...]:
    """All effects that some drive can test, most evidence first."""
    judged = [
        {c.name: c for c in assess(drive.model, grains_of(drive.model), effects, drive.record.known, drive.rest)}
        for drive in drives
    ]
    joints = [Joint(effect, tuple(found.get(effect.name) for found in judged)) for effect in effects]
    tested = [joint for joint in joints if any(joint.each)]
    return tuple(sorted(tested, key=lambda joint: -joint.log_bayes_factor))


def same_class(one: Joint, other: Joint) -> bool:
    """Whether the drives cannot tell the two apart."""
    if other.name in one.effect.equivalent or one.name in other.effect.equivalent:
        return True
    pairs = [(a, b) for a, b in zip(one.each, other.each, strict=True) if a is not None and b is not None]
    return bool(pairs) and all(abs(float(a.trace @ b.trace)) > ALIKE for a, b in pairs)


def _add(drives: tuple[Drive, ...], joint: Joint) -> tuple[Drive, ...]:
    grown = []
    for drive, candidate in zip(drives, joint.each, strict=True):
        if candidate is None or (joint.is_event and candidate.log_bayes_factor < NAMED):
            grown.append(drive)
        else:
            term = settled(candidate.term, drive.model.samples)
            grown.append(drive.having((*drive.model.terms, term)))
    return tuple(grown)


def _exchange(
    plain: tuple[Drive, ...], chosen: list[Found], drives: tuple[Drive, ...], effects: Sequence[Effect]
) -> tuple[list[Found], tuple[Drive, ...]]:
    """Let each effect but the newest stand once more against all others, given the rest."""
    for i, found in enumerate(chosen[:-1]):
        rest = tuple(drive.without(found.joint.name) for drive in drives)
        ranking = ranked(rest, effects)
        if not ranking or ranking[0].log_bayes_factor < NAMED:
            return [*chosen[:i], *chosen[i + 1 :]], rest
        chosen[i] = Found(ranking[0], ranking, found.before)
        drives = _add(rest, ranking[0])
    return chosen, drives


def _leftovers(drives: tuple[Drive, ...]) -> tuple[Leftover, ...]:
    """Processes over all drives: evidence adds up."""
    each = [{_kind(left): left for left in leftovers(grains_of(drive.model))} for drive in drives]
    samples = [len(drive.model.samples) for drive in drives]
    joined = []
    for name in each[0]:
        found = [left[name] for left in each if name in left]
        variance = sum(left[name].variance * n for left, n in zip(each, samples, strict=True) if name in left)
        joined.append(
            replace(
                found[0],
                log_bayes_factor=sum(left.log_bayes_factor for left in found),
                variance=variance / sum(samples),
            )
        )
    return tuple(sorted(joined, key=lambda left: -left.log_bayes_factor))


def _kind(left: Leftover) -> str:
    """Ripples of any period are one."""
    return "swings" if left.name.startswith("swings") else left.name


def hidden_grade(ranking: Sequence[Joint], processes: Sequence[Leftover], drives: Sequence[Drive]) -> Leftover | None:
    """A force that goes with the place and beats all that has a name: a grade that no signal shows, or None.

    Every road has one, so it need only come near the best of other processes; but no road is so flat that a force
    worth less than FLATTEST would be it. A signal of the climb that explains nothing speaks against it.
    """
    grade = next(left for left in processes if left.name == UNMEASURED_GRADE)
    refuted = any(joint.effect.is_gravity for joint in ranking)
    named = max((joint.log_bayes_factor for joint in ranking), default=0.0)
    evident = grade.log_bayes_factor > max(EVIDENT, named + AHEAD)
    best = processes[0].log_bayes_factor
    near = grade.log_bayes_factor > min(best - NAMED, NEAR * best)
    steep = grade_sd(grade, drives) > FLATTEST
    return grade if evident and near and steep and not refuted else None


def grade_sd(force: Leftover, drives: Sequence[Drive]) -> float:
    """Standard deviation of the grade [1] that would be such a force."""
    model = max((drive.model for drive in drives), key=lambda model: len(model.samples))
    speed = float(np.sqrt(np.mean(model.samples.v**2)))
    mass = max(float(model.road_load[2]), 1.0)
    return float(np.sqrt(force.variance)) / (mass * STANDARD_GRAVITY * speed)


def probabilities(log_bayes_factors: Sequence[float]) -> list[float]:
    """Of each, and last of none.

    None is likelier beforehand than all others together. Evidence is tempered, for it is never as sharp as the model
    of the noise says; and LAPSE is kept back for what no model here foresees.
    """
    rare = np.log(len(log_bayes_factors)) + RARE
    tempered = [*(value / TEMPER - rare for value in log_bayes_factors), 0.0]
    return [(1 - LAPSE) * float(np.exp(value - logsumexp(tempered))) for value in tempered]

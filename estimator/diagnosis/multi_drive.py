"""Evidence of effects over several drives of one vehicle.

An effect of the vehicle acts in all drives, so its evidence is the sum. An event, bounded in time, may act in one drive
only, so its evidence is the largest.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.diagnosis.averaged_residual import averages_of
from estimator.diagnosis.candidates import Candidate, Idling, assess
from estimator.diagnosis.drive_data import Record
from estimator.diagnosis.held_out import HeldOut, held_out
from estimator.diagnosis.model import Model, fit, select
from estimator.diagnosis.thresholds import Thresholds
from estimator.model.design_matrix import Term
from estimator.model.effects import Effect, Timing
from estimator.signals import Floats


@dataclass(frozen=True)
class Drive:
    """One record with its present model."""

    record: Record
    model: Model

    @property
    def rest(self) -> Idling | None:
        """Power and engine speed at idle; None where unknown, or where an effect in the model takes power there."""
        taken = any(term.effect.at_rest is not None for term in self.model.terms)
        return None if self.record.idling is None or taken else Idling(*self.record.idling)

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
        """Whether it may act in one drive and not in another."""
        return self.effect.timing is not Timing.ALWAYS

    @property
    def is_timed(self) -> bool:
        """Whether its switching times are fitted."""
        return self.best[1].term.spans is not None

    @property
    def best(self) -> tuple[int, Candidate]:
        """Number of the drive with most evidence, and the candidate there."""
        found = [(i, candidate) for i, candidate in enumerate(self.each) if candidate is not None]
        return max(found, key=lambda pair: pair[1].log_bayes_factor)


def ranked(
    drives: tuple[Drive, ...], effects: Sequence[Effect], beside: Sequence[Floats] | None = None
) -> tuple[Joint, ...]:
    """All effects that some drive can test, most evidence first.

    They are judged ``beside`` a process with these covariances (n, n), one for each drive; None: without one.
    """
    judged = []
    for i, drive in enumerate(drives):
        averages = averages_of(drive.model)
        if beside is not None:
            averages = replace(averages, nuisance=beside[i])
        found = assess(drive.model, averages, effects, drive.record.known, drive.rest)
        judged.append({candidate.name: candidate for candidate in found})
    joints = [Joint(effect, tuple(found.get(effect.name) for found in judged)) for effect in effects]
    tested = [joint for joint in joints if any(joint.each)]
    return tuple(sorted(tested, key=lambda joint: -joint.log_bayes_factor))


def is_same_class(one: Joint, other: Joint, thresholds: Thresholds) -> bool:
    """Whether the drives cannot separate the two effects."""
    if other.name in one.effect.equivalent or one.name in other.effect.equivalent:
        return True
    pairs = [(a, b) for a, b in zip(one.each, other.each, strict=True) if a is not None and b is not None]
    return bool(pairs) and all(abs(float(a.trace @ b.trace)) > thresholds.min_class_correlation for a, b in pairs)


def pooled(drives: tuple[Drive, ...], on: tuple[Drive, ...]) -> HeldOut:
    """Held-out residuals of the models of ``drives`` on the samples of others."""
    parts = [held_out(o.model.samples, d.model.terms, d.model.road_load) for d, o in zip(drives, on, strict=True)]
    return HeldOut(np.concatenate([part.squares for part in parts]))

"""Which effects this drive can separate, and the evidence to expect of each."""

from collections.abc import Sequence

import numpy as np

from estimator.components.budget import Projection
from estimator.components.drive_state import DriveState, Form
from estimator.diagnosis.result import Isolability, NotTestable
from estimator.model.effects import Effect, Timing
from estimator.signals import Quantity


def isolability(drive: DriveState, forms: Sequence[Form]) -> Isolability:
    """Correlation of the power of all effects on a drive, off the plain road load, and the evidence to expect."""
    ordered = sorted(forms, key=lambda form: form.component.name)
    off = Projection(drive)
    traces = [off(off.as_power(form.trace, 1 / drive.fit.beta[:1])[:, 0]) for form in ordered]
    unit = np.array([trace / max(float(np.linalg.norm(trace)), np.finfo(float).tiny) for trace in traces])
    unit = unit.reshape(len(ordered), -1)
    expected = np.array([expected_evidence(form) for form in ordered])
    return Isolability(tuple(form.component.name for form in ordered), np.abs(unit @ unit.T), expected)


def expected_evidence(form: Form) -> float:
    """Log Bayes factor to be expected of an effect of usual size."""
    strength = float(np.sqrt(max((form.component.sd / form.sd) ** 2 - 1.0, 0.0)))  # less the prior's own
    return evidence_of(strength) - form.component.cost


def evidence_of(strength: float) -> float:
    """Log Bayes factor to be expected of a usual size of ``strength`` standard deviations: Laplace's approximation."""
    return float(0.5 * strength**2 - np.log(max(strength, 1.0)))


def is_lasting(effect: Effect) -> bool:
    """Whether it acts throughout, so that it can hide in the road load."""
    return effect.absorbed or effect.timing is Timing.ALWAYS


def not_testable(effects: Sequence[Effect], known: frozenset[Quantity]) -> list[NotTestable]:
    """Effects whose signals this bus does not carry."""
    missing = [effect for effect in effects if not effect.usable_shapes(known)]
    return [NotTestable(effect.name, " or ".join(role.value for role in effect.wanted)) for effect in missing]

"""Which effects this drive can separate, and which it cannot show at their usual size."""

from collections.abc import Sequence

import numpy as np

from estimator.diagnosis.candidates import Candidate
from estimator.diagnosis.model import Model
from estimator.diagnosis.result import Invisible, Isolability, NotTestable, Shift
from estimator.diagnosis.thresholds import Thresholds
from estimator.model.effects import Effect, Timing
from estimator.signals import Quantity


def isolability(candidates: Sequence[Candidate], model: Model) -> Isolability:
    """Correlation of the traces of all candidates, and the evidence to expect of each."""
    ordered = sorted(candidates, key=lambda candidate: candidate.name)
    traces = np.array([candidate.trace for candidate in ordered]).reshape(len(ordered), -1)
    expected = np.array([expected_evidence(candidate, model) for candidate in ordered])
    return Isolability(tuple(c.name for c in ordered), np.abs(traces @ traces.T), expected)


def expected_evidence(candidate: Candidate, model: Model) -> float:
    """Log Bayes factor to be expected of an effect of usual size."""
    return evidence_of(candidate.term.effect.usual(model.road_load) / candidate.sd) - candidate.cost


def evidence_of(strength: float) -> float:
    """Log Bayes factor to be expected of a usual size of ``strength`` standard deviations: Laplace's approximation."""
    return float(0.5 * strength**2 - np.log(max(strength, 1.0)))


def invisible(
    effects: Sequence[Effect],
    candidates: Sequence[Candidate],
    model: Model,
    known: frozenset[Quantity],
    thresholds: Thresholds,
) -> list[Invisible]:
    """Effects that could act at their usual size without evidence, and the shift of A, C and m they would cause."""
    judged = {candidate.name: candidate for candidate in candidates}
    present = {term.effect.name for term in model.terms}
    found = []
    for effect in effects:
        if effect.name in present or not effect.usable_shapes(known):
            continue
        candidate = judged.get(effect.name)
        expected = expected_evidence(candidate, model) if candidate else 0.0
        if is_lasting(effect) and expected < thresholds.min_expected_log_bf:
            found.append(Invisible(effect.name, expected, _shift(effect, model, known), effect.breaks))
    return found


def is_lasting(effect: Effect) -> bool:
    """Whether it acts throughout, so that it can hide in the road load."""
    return effect.absorbed or effect.timing is Timing.ALWAYS


def _shift(effect: Effect, model: Model, known: frozenset[Quantity]) -> Shift:
    """Shift of the parameters when the effect acts at its usual size and is not in the model."""
    own, _ = model.views()
    power = effect.power(own, effect.usable_shapes(known)[0])
    change = effect.usual(model.road_load) * (model.base.inverse @ (model.base.Z.T @ power))
    return Shift(mass=float(change[2]), A=float(change[0]), C=float(change[1]))


def not_testable(effects: Sequence[Effect], known: frozenset[Quantity]) -> list[NotTestable]:
    """Effects whose signals this bus does not carry."""
    missing = [effect for effect in effects if not effect.usable_shapes(known)]
    return [NotTestable(effect.name, " or ".join(role.value for role in effect.wanted)) for effect in missing]

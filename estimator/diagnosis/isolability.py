"""Effects that a drive can separate, the expected evidence of each, and effects that it cannot show."""

from collections.abc import Sequence

import numpy as np

from estimator.components.drive_state import DriveState, Form
from estimator.components.plain_model import PlainModel
from estimator.components.term import Frame, of_effect
from estimator.diagnosis.result import Invisible, Isolability, NotTestable, Shift
from estimator.estimation.road_fit import theta_jacobian
from estimator.model.effects import Effect, Timing
from estimator.signals import Quantity


def isolability(drive: DriveState, forms: Sequence[Form]) -> Isolability:
    """|Correlation| of the power of effects on a drive, less the plain road load, and their expected evidence."""
    ordered = sorted(forms, key=lambda form: form.term.name)
    plain = PlainModel(drive.fit)
    traces = [plain.residual(plain.as_power(form.trace, 1 / drive.fit.beta[:1])[:, 0]) for form in ordered]
    unit = np.array([trace / max(float(np.linalg.norm(trace)), np.finfo(float).tiny) for trace in traces])
    unit = unit.reshape(len(ordered), -1 if ordered else 0)
    expected = np.array([expected_evidence(form) for form in ordered])
    return Isolability(tuple(form.term.name for form in ordered), np.abs(unit @ unit.T), expected)


def expected_evidence(form: Form) -> float:
    """Expected log Bayes factor of an effect of usual magnitude."""
    strength = float(np.sqrt(max((form.term.sd / form.sd) ** 2 - 1.0, 0.0)))  # less the information of the prior
    return evidence_of(strength) - form.term.cost


def evidence_of(strength: float) -> float:
    """Expected log Bayes factor of a magnitude of ``strength`` standard deviations, by Laplace's approximation."""
    return float(0.5 * strength**2 - np.log(max(strength, 1.0)))


def invisible(drive: DriveState, effects: Sequence[Effect], least: float) -> tuple[Invisible, ...]:
    """Effects with an expected log Bayes factor below ``least`` at usual magnitude, and the shift they cause."""
    known, present = frozenset(drive.strides.context), {term.name for term in drive.chosen}
    lasting = [effect for effect in effects if is_lasting(effect) and effect.name not in present]
    frame, ours = Frame.of(drive.fit), range(len(drive.chosen))
    forms = [(effect, form) for effect in lasting for form in of_effect(frame, effect, known)]
    joint = drive.joint_with([form for _, form in forms])
    places = range(len(ours), len(ours) + len(forms))
    sds = joint.gains(ours, places).sd
    jacobian = theta_jacobian(joint.posterior(ours).mean[: joint.base_size], 0)
    best: dict[str, Invisible] = {}
    for place, sd, (effect, form) in zip(places, sds.tolist(), forms, strict=True):
        strength = float(np.sqrt(max((form.sd / sd) ** 2 - 1.0, 0.0)))  # less the information of the prior
        A, C, m, *_ = (jacobian @ joint.imitated(ours, place)[: joint.base_size] * form.sd).tolist()
        found = Invisible(effect.name, evidence_of(strength), Shift(mass=m, A=A, C=C), effect.shown_by)
        most = best.setdefault(effect.name, found)
        if found.expected_log_bayes_factor > most.expected_log_bayes_factor:
            best[effect.name] = found
    return tuple(one for one in best.values() if one.expected_log_bayes_factor < least)


def is_lasting(effect: Effect) -> bool:
    """True if the effect acts during the whole drive, so that the fit can take it for road load."""
    return effect.is_absorbed or effect.timing is Timing.ALWAYS


def not_testable(effects: Sequence[Effect], known: frozenset[Quantity]) -> list[NotTestable]:
    """Effects that need a signal which is not among the ``known`` quantities."""
    missing = [effect for effect in effects if not effect.usable_shapes(known)]
    return [NotTestable(effect.name, " or ".join(role.value for role in effect.wanted_roles)) for effect in missing]

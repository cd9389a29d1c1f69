"""Compute which effects a drive can separate, the expected evidence of each, and which it cannot show."""

from collections.abc import Sequence

import numpy as np

from estimator.components.drive_state import DriveState, FittedTerm
from estimator.components.plain_model import PlainModel
from estimator.components.term import Frame, untimed_terms
from estimator.diagnosis.result import Invisible, Isolability, NotTestable, Shift
from estimator.estimation.road_fit import theta_jacobian
from estimator.model.effects import Effect, Timing
from estimator.signals import Quantity


def isolability(drive: DriveState, fitted_terms: Sequence[FittedTerm], lasting: Sequence[Invisible]) -> Isolability:
    """|Correlation| of the power of effects on a drive, less the plain road load, and their expected evidence.

    That of ``lasting`` effects is beside the chosen ones, that of others alone.
    """
    ordered = sorted(fitted_terms, key=lambda fitted: fitted.term.name)
    plain = PlainModel(drive.fit)
    traces = [plain.residual(plain.as_power(fitted.trace, 1 / drive.fit.beta[:1])[:, 0]) for fitted in ordered]
    unit = np.array([trace / max(float(np.linalg.norm(trace)), np.finfo(float).tiny) for trace in traces])
    unit = unit.reshape(len(ordered), -1 if ordered else 0)
    beside = {effect.name: effect.expected_log_bayes_factor for effect in lasting}
    expected = np.array([beside.get(fitted.term.name, expected_evidence(fitted)) for fitted in ordered])
    return Isolability(tuple(fitted.term.name for fitted in ordered), np.abs(unit @ unit.T), expected)


def expected_evidence(fitted: FittedTerm) -> float:
    """Expected log Bayes factor of an effect of usual magnitude."""
    strength = float(np.sqrt(max((fitted.term.sd / fitted.sd) ** 2 - 1.0, 0.0)))  # less the information of the prior
    return evidence_of(strength) - fitted.term.cost


def evidence_of(strength: float) -> float:
    """Expected log Bayes factor of a magnitude of ``strength`` standard deviations, by Laplace's approximation."""
    return float(0.5 * strength**2 - np.log(max(strength, 1.0)))


def lasting_effects(drive: DriveState, effects: Sequence[Effect]) -> tuple[Invisible, ...]:
    """Lasting effects with the log Bayes factor expected at usual magnitude beside the chosen ones, and their shift."""
    quantities, present = frozenset(drive.strides.context), {term.name for term in drive.chosen}
    absent = [effect for effect in effects if is_lasting(effect) and effect.name not in present]
    frame, chosen = Frame.of(drive.fit), range(len(drive.chosen))
    terms = [(effect, term) for effect in absent for term in untimed_terms(frame, effect, quantities)]
    joint = drive.joint_with([term for _, term in terms])
    numbers = range(len(chosen), len(chosen) + len(terms))
    sds = joint.gains(chosen, numbers).sd
    jacobian = theta_jacobian(joint.posterior(chosen).mean[: joint.base_size], 0)
    best: dict[str, Invisible] = {}
    for number, sd, (effect, term) in zip(numbers, sds.tolist(), terms, strict=True):
        strength = float(np.sqrt(max((term.sd / sd) ** 2 - 1.0, 0.0)))  # less the information of the prior
        A, C, m, *_ = (jacobian @ joint.omission_bias(chosen, number)[: joint.base_size] * term.sd).tolist()
        expected = Invisible(effect.name, evidence_of(strength), Shift(mass=m, A=A, C=C), effect.shown_by)
        most = best.setdefault(effect.name, expected)
        if expected.expected_log_bayes_factor > most.expected_log_bayes_factor:
            best[effect.name] = expected
    return tuple(best.values())


def is_lasting(effect: Effect) -> bool:
    """True if the effect acts during the whole drive, so that the fit can take it for road load."""
    return effect.is_absorbed or effect.timing is Timing.ALWAYS


def not_testable(effects: Sequence[Effect], quantities: frozenset[Quantity]) -> list[NotTestable]:
    """Effects that need a signal which is not among the known ``quantities``."""
    missing = [effect for effect in effects if not effect.usable_shapes(quantities)]
    return [NotTestable(effect.name, effect.wanted(quantities)) for effect in missing]

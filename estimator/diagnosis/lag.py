"""The lag between power and speed as a finding: it is in every model, and named where it is beyond usual delays."""

import numpy as np

from estimator.components.budget import SDS_OF_90_PERCENT, Budget, Residuals
from estimator.components.drive_state import DriveState
from estimator.components.plain_model import PlainModel
from estimator.components.processes import LOW_PASS, USUAL_LAG
from estimator.diagnosis.explanation import Explanation
from estimator.diagnosis.result import EARLY, LATE, Finding, GapClosed, Magnitude
from estimator.estimation.road_likelihood import LAG
from estimator.model.effects import BY_NAME, Effect
from estimator.signals import Floats

STRETCHES = 20  # of a drive, whose residuals are independent
LONGEST_LAG = 0.8  # s: shifts of power up to 0.6 s are tried, beyond 0.8 s the columns are extrapolated
LAG_DOUBT = 0.005  # s, sd from the form of effects: so 90 % intervals held the lag of 54 of 60 simulated drives
MIN_LOG_BF = 8.0  # of a lag outside USUAL_LAG, that of four standard deviations


def evidence_of_lag(explanation: Explanation) -> float | None:
    """Log Bayes factor of a lag beyond usual delays and of what a low-pass does besides; None: it is not named.

    Nor is it where an error of the form of a large effect may give as much.
    """
    value, sd = _lag(explanation)
    excess = max(value - USUAL_LAG[1], USUAL_LAG[0] - value, 0.0) / sd
    found = 0.5 * excess**2 + low_pass_gain(explanation)
    least = max(MIN_LOG_BF, explanation.explained.error_of_form)
    return found if excess and found >= least and abs(value) <= LONGEST_LAG else None


def low_pass_gain(explanation: Explanation) -> float:
    """Log Bayes factor of a low-pass of the speed, where nothing else without a name has more."""
    nameless = explanation.explained.nameless
    is_low_pass = any(process.name == LOW_PASS for process in nameless.processes.values())
    return nameless.log_bayes_factor if is_low_pass else 0.0


def lag_finding(explanation: Explanation, budget: Budget) -> Finding | None:
    """The lag, where it is beyond usual delays: the plain model on power as it was measured, and on aligned power."""
    evidence = evidence_of_lag(explanation)
    if evidence is None:
        return None
    value, sd = _lag(explanation)
    effect = effect_of(explanation)
    drives = zip(explanation.explained.drives, budget.residuals, strict=True)
    unaligned = np.concatenate([unaligned_residual(drive, residuals) for drive, residuals in drives])
    aligned = np.concatenate([residuals.given for residuals in budget.residuals])
    return Finding(
        name=effect.name,
        probability=1.0,
        log_bayes_factor=evidence,
        equivalent=effect.equivalent,
        magnitude=Magnitude(effect.symbol, value, sd, effect.unit),
        gap_closed=_closed_by_alignment(unaligned**2, aligned**2),
        rms_before=float(np.sqrt(np.mean(unaligned**2))),
        rms_after=budget.base,
        shift=None,
        detail="taken out by the alignment",
    )


def unaligned_residual(drive: DriveState, residuals: Residuals) -> Floats:
    """Residual [W] (k,) of the plain model with what is given, over means of 2 s, on power as it was measured."""
    plain = PlainModel(drive.fit, is_aligned=False)
    return plain.residual(plain.power) - (residuals.plain - residuals.given)


def effect_of(explanation: Explanation) -> Effect:
    """The effect that a lag is called: power is late, or early where the speed is filtered."""
    return BY_NAME[LATE if _lag(explanation)[0] > 0 else EARLY]


def _lag(explanation: Explanation) -> tuple[float, float]:
    """Lag of power [s] and its sd, beside the effects that were chosen."""
    fit = explanation.longest.fit
    return float(fit.lag), float(np.sqrt(fit.theta_covariance()[LAG, LAG] + LAG_DOUBT**2))


def _closed_by_alignment(before: Floats, after: Floats) -> GapClosed:
    """Share of the squared residual beyond noise that the alignment takes away: all, if it takes any.

    The interval is that of the reduction over stretches of the drive, in shares of its mean.
    """
    gains = np.array([stretch.mean() for stretch in np.array_split(before - after, STRETCHES)])
    doubt = SDS_OF_90_PERCENT * float(gains.std() / np.sqrt(len(gains)) / max(gains.mean(), 1e-9))
    return GapClosed(1.0, float(np.clip(1 - doubt, 0.0, 1.0)), 1.0)

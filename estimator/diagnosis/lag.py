"""Compute the finding of the lag between power and speed: a term of every fit, which is named beyond usual delays."""

import numpy as np

from estimator.components.budget import SDS_OF_90_PERCENT, Budget, Residuals
from estimator.components.drive_state import DriveState
from estimator.components.plain_model import PlainModel
from estimator.components.processes import LOW_PASS, USUAL_LAG
from estimator.components.search_result import SearchResult
from estimator.diagnosis.result import EARLY, LATE, Finding, GapClosed, Magnitude
from estimator.estimation.road_likelihood import LAG
from estimator.model.effects import BY_NAME, Effect
from estimator.signals import Floats

STRETCHES = 20  # of a drive, whose residuals are taken as independent
LONGEST_LAG = 0.8  # s: shifts of power up to 0.6 s are computed, beyond 0.8 s the columns would be extrapolated too far
LAG_DOUBT = 0.005  # s, sd from errors of form of effects: 90 % intervals then held the lag of 54 of 60 simulated drives
MIN_LOG_BF = 8.0  # of a lag outside USUAL_LAG: four standard deviations


def evidence_of_lag(result: SearchResult) -> float | None:
    """Log Bayes factor of a lag beyond usual delays, with that of a low-pass of the speed; None if it is not named.

    It is not named where an error of form of a large effect can give as much evidence.
    """
    value, sd = _lag(result)
    excess = max(value - USUAL_LAG[1], USUAL_LAG[0] - value, 0.0) / sd
    evidence = 0.5 * excess**2 + log_bf_low_pass(result)
    least = max(MIN_LOG_BF, result.error_of_form)
    return evidence if excess and evidence >= least and abs(value) <= LONGEST_LAG else None


def log_bf_low_pass(result: SearchResult) -> float:
    """Log Bayes factor of a low-pass of the speed if no other nameless process has more, else 0."""
    nameless = result.nameless
    is_low_pass = any(process.name == LOW_PASS for process in nameless.term_by_drive.values())
    return nameless.log_bayes_factor if is_low_pass else 0.0


def lag_finding(result: SearchResult, budget: Budget) -> Finding | None:
    """Finding of a lag beyond usual delays, else None.

    Its residuals are those of the plain model on power as measured (before) and on power shifted by the lag (after).
    """
    evidence = evidence_of_lag(result)
    if evidence is None:
        return None
    value, sd = _lag(result)
    effect = lag_effect(result)
    drives = zip(result.drives, budget.residuals, strict=True)
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
    """Residual [W] (k,) of the plain model with the given effects, over means of 2 s, on power as measured."""
    plain = PlainModel(drive.fit, is_aligned=False)
    return plain.residual(plain.power) - (residuals.plain - residuals.given)


def lag_effect(result: SearchResult) -> Effect:
    """Catalogue entry of the lag: LATE if power lags speed, else EARLY, as where the speed is low-passed."""
    return BY_NAME[LATE if _lag(result)[0] > 0 else EARLY]


def _lag(result: SearchResult) -> tuple[float, float]:
    """Lag of power behind speed [s] and its sd, by the fit of the longest drive with the chosen effects."""
    fit = result.longest.fit
    return float(fit.lag), float(np.sqrt(fit.theta_covariance()[LAG, LAG] + LAG_DOUBT**2))


def _closed_by_alignment(before: Floats, after: Floats) -> GapClosed:
    """Share that the alignment closes: 1, with a 90 % interval below it.

    The interval is that of the mean reduction of the squared residual over STRETCHES, relative to this mean.
    """
    gains = np.array([stretch.mean() for stretch in np.array_split(before - after, STRETCHES)])
    doubt = SDS_OF_90_PERCENT * float(gains.std() / np.sqrt(len(gains)) / max(gains.mean(), 1e-9))
    return GapClosed(1.0, float(np.clip(1 - doubt, 0.0, 1.0)), 1.0)

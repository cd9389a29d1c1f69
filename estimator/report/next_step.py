"""The advice beside a status that is not "estimated": the next step of a user."""

from estimator.estimates import Estimate, Status
from estimator.samples import STEP
from estimator.settings import Gate
from estimator.streaming.replay import Run

DIAGNOSE = (
    "`roadload diagnose` with the same logs names a missing effect, and the line for the configuration where the model "
    "can hold it"
)


def next_step(run: Run) -> str:
    """The advice in one line; empty where there is an estimate, or where the reason for none says it."""
    final, pipeline = run.final, run.pipeline
    if final.status == Status.ESTIMATED:
        return ""
    if final.remedy is not None:
        return final.remedy
    if final.status == Status.INVALID:
        return f"check with `roadload inspect` what the reason names; where that is right, {DIAGNOSE}"
    gate = pipeline.config.gate
    if final.admitted < gate.minimum_samples:
        needed = gate.minimum_samples * STEP / 60
        return (
            f"give a longer log, or several of one load in their order: it takes {needed:.3g} min of pulling, without "
            "brake, shift or standstill; `roadload inspect` shows whether signals are missing for part of the time"
        )
    if not final.coverage.available:
        return (
            "check signals and units with `roadload inspect`, and the boxes of [prior] where the vehicle is no truck; "
            "then give a longer log with more speeds and accelerations"
        )
    if _is_coverage_low(final, gate):
        return "give a longer log, or several of one load in their order, with more speeds and accelerations"
    return f"give a longer log, or several of one load in their order; where another effect acts, {DIAGNOSE}"


def _is_coverage_low(final: Estimate, gate: Gate) -> bool:
    return final.coverage.occupied < gate.minimum_cells or final.coverage.fraction < gate.coverage

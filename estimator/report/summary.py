"""The answer of `roadload estimate` and `roadload replay`."""

from dataclasses import asdict

from msgspec import UNSET

from estimator.answers import run as answer
from estimator.answers.run import RunAnswer
from estimator.estimates import Estimate
from estimator.report.next_step import next_step
from estimator.report.run_warnings import warnings_of
from estimator.streaming.replay import Run


def of_run(run: Run) -> RunAnswer:
    """A whole run, with every update; times count from the first frame [s]."""
    final, pipeline = run.final, run.pipeline
    traffic = pipeline.traffic
    return RunAnswer(
        status=final.status,
        reason=final.reason,
        advice=next_step(run),
        warnings=warnings_of(pipeline.config, traffic.errors),
        parameters=parameters(final),
        convergence=convergence(final),
        coverage=coverage(final),
        road=_road(final),
        rms_kW=None if final.rms is None else final.rms / 1e3,
        samples=answer.Samples(admitted=final.admitted, rejected=dict(pipeline.estimator.rejected)),
        frames=answer.Frames(
            read=traffic.frames,
            used=traffic.used,
            reordered=traffic.order.reordered,
            steps_back=traffic.order.steps_back,
            errors=dict(run.skipped + traffic.errors),
        ),
        failed_updates=pipeline.estimator.failed_updates,
        effects=tuple(pipeline.effects),
        magnitudes=final.effects,
        updates=tuple(_update(update, run.start) for update in run.updates),
    )


def parameters(estimate: Estimate) -> answer.Parameters:
    """The marginals under their names with units, each with its status."""
    return answer.Parameters(
        mass_kg=_parameter(estimate, "m"), A_N=_parameter(estimate, "A"), C_N_s2_m2=_parameter(estimate, "C")
    )


def _parameter(estimate: Estimate, which: str) -> answer.Parameter:
    status, reason = estimate.status_of(which)
    marginal = estimate.marginals[which]
    values = {} if marginal is None else asdict(marginal)
    return answer.Parameter(status=status, reason=reason, **values)


def convergence(estimate: Estimate) -> answer.Convergence | None:
    """Diagnostics of the chains behind an estimate."""
    found = estimate.convergence
    return None if found is None else answer.Convergence(**asdict(found))


def coverage(estimate: Estimate) -> answer.Coverage:
    """Coverage with its fraction."""
    cells = estimate.coverage
    return answer.Coverage(fraction=cells.fraction, occupied=cells.occupied, available=cells.available)


def _road(estimate: Estimate) -> answer.Road | None:
    found = estimate.road
    if found is None:
        return None
    return answer.Road(slope_sd=found.slope_sd, length_m=found.length, shown_by=found.shown_by, climbed_m=found.climbed)


def _update(update: Estimate, start: float) -> answer.Update:
    change = update.load
    return answer.Update(
        t_s=round(update.t - start, 3),
        status=update.status,
        parameters=parameters(update),
        load_changed=UNSET
        if change is None
        else answer.LoadChanged(
            probability=change.probability, mass_before_kg=change.before, mass_after_kg=change.after
        ),
    )

"""Estimates as answers: of `roadload estimate` and `roadload replay`, and the parts that status and watch share."""

from dataclasses import asdict
from math import isfinite

import numpy as np
from msgspec import UNSET

from estimator.answers import run as answer
from estimator.answers import status
from estimator.answers.reference import References
from estimator.answers.run import RunAnswer
from estimator.estimates import Estimate, Marginal, Slope, drag_area
from estimator.estimation.window import CELLS, MIN_ACCELERATION, Window
from estimator.report import parameter_text
from estimator.report.next_step import next_step
from estimator.report.run_warnings import warnings_of
from estimator.settings import Gate
from estimator.streaming.pipeline import Pipeline
from estimator.streaming.replay import Run
from estimator.units import KMH, STANDARD_DENSITY


def of_run(run: Run) -> RunAnswer:
    """A whole run, with every update; times count from the first frame [s]."""
    final, pipeline = run.final, run.pipeline
    traffic = pipeline.traffic
    return RunAnswer(
        status=final.status,
        reason=final.reason,
        advice=next_step(run),
        warnings=warnings(run),
        parameters=parameters(final),
        convergence=convergence(final),
        coverage=coverage(final),
        road=road(final),
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
        updates=tuple(_update(update, run) for update in run.updates),
        coefficients=coefficients(final),
        coverage_map=coverage_map(pipeline.estimator.window, pipeline.config.gate, final),
        references=references(pipeline, final),
    )


def warnings(run: Run) -> tuple[str, ...]:
    """One line for each thing that widens the estimate, was left out of it, or may be wrong in the DBC."""
    traffic = run.pipeline.traffic
    doubts = [run.final.doubt] if run.final.doubt else []
    return (*doubts, *traffic.remarks, *warnings_of(run.pipeline.config, traffic.errors))


def references(pipeline: Pipeline, estimate: Estimate | None) -> References:
    """Estimates of other control units as of the newest frame, compared with an estimate."""
    traffic, evidence = pipeline.traffic, pipeline.estimator.evidence
    mass = None if estimate is None or estimate.mass is None else (estimate.mass.mean, estimate.mass.sd)
    return traffic.references.answer(traffic.until, mass, None if evidence is None else evidence.fit)


def parameters(estimate: Estimate) -> answer.Parameters:
    """The marginals under their names with units, each with its status."""
    return answer.Parameters(
        mass_kg=_parameter(estimate, "m"), A_N=_parameter(estimate, "A"), C_N_s2_m2=_parameter(estimate, "C")
    )


def coefficients(estimate: Estimate) -> answer.Coefficients:
    """Coefficients that follow from mass, A and C, each estimated where these are."""
    C, density = estimate.C, estimate.air_density
    return answer.Coefficients(
        c_rr=_derived(estimate, "A", estimate.c_rr),
        c_d_A_m2=_derived(estimate, "C", None if C is None else drag_area(C, density)),
        air_density_kg_m3=density or STANDARD_DENSITY,
        is_density_measured=density is not None,
        coast_down=answer.CoastDown(
            F0_N=_parameter(estimate, "A"),
            F1_N_h_km=0.0,
            F2_N_h2_km2=_derived(estimate, "C", None if C is None else C.times(1 / KMH**2)),
        ),
    )


def _parameter(estimate: Estimate, which: str) -> answer.Parameter:
    return _derived(estimate, which, estimate.marginals[which])


def _derived(estimate: Estimate, which: str, marginal: Marginal | None) -> answer.Parameter:
    """A parameter that is known where ``which`` is."""
    known, reason = estimate.status_of(which)
    values = {} if marginal is None or estimate.marginals[which] is None else asdict(marginal)
    return answer.Parameter(status=known, reason=reason, **values)


def convergence(estimate: Estimate) -> answer.Convergence | None:
    """Diagnostics of the chains behind an estimate."""
    found = estimate.convergence
    return None if found is None else answer.Convergence(**asdict(found))


def coverage(estimate: Estimate) -> answer.Coverage:
    """Coverage with its fraction."""
    cells = estimate.coverage
    return answer.Coverage(fraction=cells.fraction, occupied=cells.occupied, available=cells.available)


def road(estimate: Estimate) -> answer.Road | None:
    """Slopes of the road, where the model has one."""
    found = estimate.road
    if found is None:
        return None
    return answer.Road(
        slope_sd=found.slope_sd,
        length_m=found.length,
        shown_by=found.shown_by,
        climbed_m=found.climbed,
        contradicted=found.contradicted,
    )


def coverage_map(window: Window, gate: Gate, latest: Estimate | None) -> answer.CoverageMap:
    """The cells that were driven so far, and those that the latest estimate found wanted."""
    counts = window.counts
    driven = np.flatnonzero(counts)
    return answer.CoverageMap(
        speed_step_m_s=window.grid.speed_step,
        acceleration_step_m_s2=window.grid.acceleration_step,
        lowest_acceleration_m_s2=MIN_ACCELERATION,
        needed=gate.cell_count,
        rows=tuple((*divmod(cell, CELLS), int(counts[cell])) for cell in driven.tolist()),
        wanted=() if latest is None else tuple(divmod(cell, CELLS) for cell in latest.coverage.wanted),
    )


def conclusion(estimate: Estimate | None, t: float, start: float | None) -> status.Estimate | None:
    """The latest conclusion as of message time ``t`` [s]; the first frame came at ``start`` [s]."""
    if estimate is None:
        return None
    return status.Estimate(
        status=estimate.status,
        reason=estimate.reason,
        age_s=round(t - estimate.t, 3),
        samples=estimate.admitted,
        parameters=parameters(estimate),
        convergence=convergence(estimate),
        coverage=coverage(estimate),
        t_s=None if start is None else round(estimate.t - start, 3),
        road=road(estimate),
        coefficients=coefficients(estimate),
        doubt=estimate.doubt,
    )


def in_one_line(estimate: Estimate) -> str:
    """The estimate for a line of a log, or why there is none."""
    return parameter_text.line(estimate.status, estimate.reason, parameters(estimate), coverage(estimate))


def progress(pipeline: Pipeline, history: tuple[answer.Past, ...]) -> status.Progress:
    """How far the driving has come, with the conclusions so far."""
    traffic, gate = pipeline.traffic, pipeline.config.gate
    return status.Progress(
        t_s=None if traffic.until is None or traffic.start is None else round(traffic.until - traffic.start, 3),
        samples=len(pipeline.estimator.window),
        needed=answer.Needed(samples=gate.minimum_samples, cells=gate.minimum_cells, coverage=gate.coverage),
        coverage_map=coverage_map(pipeline.estimator.window, gate, pipeline.latest),
        history=history,
    )


def past(estimate: Estimate, start: float) -> answer.Past:
    """A conclusion as a point of the history; ``start`` is the time of the first frame [s]."""
    return answer.Past(
        t_s=round(estimate.t - start, 3),
        status=estimate.status,
        mass_kg=_quantiles(estimate.mass),
        A_N=_quantiles(estimate.A),
        C_N_s2_m2=_quantiles(estimate.C),
    )


def _quantiles(x: Marginal | None) -> answer.Quantiles | None:
    return None if x is None else answer.Quantiles(q05=x.q05, mean=x.mean, q95=x.q95)


def road_now(slope: Slope) -> answer.RoadNow:
    """The road under the vehicle, in units for people."""
    return answer.RoadNow(
        grade_percent=100 * slope.grade,
        sd_percent=100 * slope.grade_sd,
        height_m=slope.height if isfinite(slope.height) else None,
        height_sd_m=slope.height_sd if isfinite(slope.height_sd) else None,
    )


def _update(update: Estimate, run: Run) -> answer.Update:
    change, slope = update.load, run.slope_at(update.t)
    return answer.Update(
        t_s=round(update.t - run.start, 3),
        status=update.status,
        parameters=parameters(update),
        load_changed=UNSET
        if change is None
        else answer.LoadChanged(
            probability=change.probability, mass_before_kg=change.before, mass_after_kg=change.after
        ),
        road_now=UNSET if slope is None else road_now(slope),
    )

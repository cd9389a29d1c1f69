"""Compute the findings of a diagnosis: evidence and magnitude of each effect, the road, the lag and processes."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.answers.diagnosis import Verdict
from estimator.components.budget import ROAD, SDS_OF_90_PERCENT, UNKNOWN, WHITE, Part, Residuals
from estimator.components.drive_state import DriveState
from estimator.components.processes import SWITCHES
from estimator.components.search_result import ChosenEffect, RankedEffect
from estimator.diagnosis.decision import Decision
from estimator.diagnosis.facts import MIN_RIVAL
from estimator.diagnosis.lag import STRETCHES
from estimator.diagnosis.result import (
    HIDDEN_GRADE,
    SHOWN_SLOPE,
    Finding,
    GapClosed,
    Magnitude,
    Remainder,
    Span,
)
from estimator.estimates import not_showing
from estimator.estimation.form_doubt import EFFECT_DOUBT
from estimator.model.effects import BY_NAME, Effect
from estimator.model.spans import Spans
from estimator.signals import Floats, Quantity

SLOPE_LENGTH = 300.0  # m, beyond which slopes of a road are independent
SHOWN_IN_PART, SHOWN = 0.1, 0.9  # share of the reduction by a known road that its signals give


def named_findings(decision: Decision) -> tuple[Finding, ...]:
    """The road, the effects that are named, and the lag; each residual is with the causes before it too."""
    road = [_road_finding(decision)] if decision.is_road_named else []
    effects = [
        _effect_finding(decision, effect, [*(ROAD for _ in road), *(other.name for other in decision.named[:i])])
        for i, effect in enumerate(decision.named)
    ]
    found, lag = (*road, *effects), decision.lag
    return found if lag is None else of_aligned_power(found, lag, decision.budget.floor)


def of_aligned_power(found: Sequence[Finding], lag: Finding, floor: float) -> tuple[Finding, ...]:
    """Findings of ``found`` causes on aligned power, then that of the ``lag``, with their shares of the whole gap.

    The gap is the square of the residual above the noise ``floor`` [W]: the lag closes what the alignment takes, and
    the causes found closed shares of the rest.
    """
    aligned = lag.rms_before**2 - lag.rms_after**2
    rest = max(lag.rms_after**2 - floor**2, 0.0) if found else 0.0
    by_lag = aligned / (aligned + rest) if aligned > 0 else 1.0
    return (*(_scaled(finding, 1 - by_lag) for finding in found), _scaled(lag, by_lag))


def _scaled(finding: Finding, factor: float) -> Finding:
    """The finding with ``factor`` times its share of the gap."""
    closed = finding.gap_closed
    if closed is None:
        return finding
    return replace(
        finding, gap_closed=GapClosed(*(factor * share for share in (closed.fraction, closed.q05, closed.q95)))
    )


def candidate_findings(decision: Decision, named: Sequence[Finding]) -> tuple[Finding, ...]:
    """All effects, each alone, with their probabilities in the table of models; road, lag and unknown effect.

    Those with most evidence are first.
    """
    ranking = decision.result.ranking
    names = {effect.name for effect in ranking}
    others = [finding for finding in named if finding.name not in names]
    alone = [_candidate_finding(decision, effect, ranking) for effect in ranking]
    return tuple(sorted((*others, *alone, _unknown_finding(decision)), key=lambda f: -f.log_bayes_factor))


def remainder(decision: Decision) -> Remainder:
    """The nameless processes beside the named effects, and their evidence."""
    unknown = _unknown_finding(decision)
    return Remainder(unknown.detail, unknown.magnitude.value, decision.log_bf_unknown)


def _road_finding(decision: Decision) -> Finding:
    """Finding of a sloping road; it names the signals that show it, if there are any."""
    hidden, readings = _hidden_road_finding(decision), decision.longest.fit.scales.readings
    if not readings:
        return hidden
    part, base = decision.budget.part(ROAD), decision.budget.base
    reached = base if part is None or part.held_out_rms is None else part.held_out_rms
    shown = (base**2 - reached**2) / max(base**2 - hidden.rms_after**2, 1e-9)
    if shown < SHOWN_IN_PART:
        return hidden
    closed = None if part is None else of_shown_road(part.closed, shown, decision.budget.residuals)
    how = "shown by" if shown > SHOWN else "shown in part by"
    signals = ", ".join(readings) + _not_showing(decision)
    return replace(
        hidden,
        magnitude=replace(hidden.magnitude, name=SHOWN_SLOPE),
        gap_closed=closed,
        rms_after=reached,
        shift=decision.shift,
        detail=f"varies with place; {how} {signals}",
    )


def of_shown_road(closed: tuple[float, float, float], shown: float, drives: Sequence[Residuals]) -> GapClosed:
    """Share of the gap that a road closes as far as signals show it, with its 90 % interval.

    Parameters
    ----------
    closed
        Share of the whole road, with its interval.
    shown
        Reduction of the squared residual by the signals, over that by a known road. It is of these stretches: on others
        the signals would show more or less, so the interval counts the scatter of this ratio over STRETCHES as well.
    drives
        Residuals of each drive, of which the ratio is.
    """
    before, by_signals, known = (
        np.concatenate(each) ** 2
        for each in zip(*((d.given, d.given - d.causes.get(ROAD, 0.0), d.road_known) for d in drives), strict=True)
    )
    excess = (before - by_signals) - shown * (before - known)
    means = np.array([stretch.mean() for stretch in np.array_split(excess, STRETCHES)])
    whole = max(float(np.mean(before - known)), 1e-9)
    doubt = SDS_OF_90_PERCENT * float(means.std(ddof=1)) / np.sqrt(STRETCHES) / whole
    shown = min(shown, 1.0)
    mean, low, high = (shown * share for share in closed)
    below, above = np.hypot([mean - low, high - mean], doubt).tolist()
    return GapClosed(mean, max(mean - below, 0.0), min(mean + above, 1.0))


def _hidden_road_finding(decision: Decision) -> Finding:
    """Finding of a road that no signal shows, with the share of the gap that an ideal signal would close."""
    budget = decision.budget
    slope_sd, sd = _slopes(decision.result.drives)
    part = budget.part(ROAD)
    return Finding(
        name="grade",
        probability=1.0,
        log_bayes_factor=decision.result.slopes or 0.0,
        equivalent=(),
        magnitude=Magnitude(HIDDEN_GRADE, slope_sd, sd, "1"),
        gap_closed=_closed(part),
        rms_before=budget.base,
        rms_after=budget.base if part is None else part.expected,
        shift=decision.shift,
        detail="varies with place; no signal on the bus shows it" + _not_showing(decision),
    )


def _not_showing(decision: Decision) -> str:
    return not_showing(decision.cases[decision.result.longest_number].contradicted)


def _effect_finding(decision: Decision, chosen: ChosenEffect, before: Sequence[str]) -> Finding:
    """Finding of a chosen effect; its residual is with the causes named ``before`` it."""
    drives, budget = decision.result.drives, decision.budget
    drive = drives[chosen.drive]
    number = next(i for i, term in enumerate(drive.chosen) if term.name == chosen.name)
    joint = drive.joint
    posterior, column = joint.posterior(range(len(drive.chosen))), joint.term_columns[number][0]
    effect_term = drive.chosen[number].effect_term
    assert effect_term is not None
    part, effect, value = budget.part(chosen.name), chosen.effect, float(posterior.mean[column])
    sd = float(np.hypot(np.sqrt(posterior.covariance[column, column]), EFFECT_DOUBT * value))
    rivals, probability = _rivals(decision, chosen)
    spans = [
        span
        for drive_number, state in enumerate(drives)
        for term in state.chosen
        if term.name == chosen.name
        for span in _log_spans(decision, drive_number, term.spans or ())
    ]
    is_nameless_rival = probability < decision.thresholds.min_probability and decision.nameless.probability > MIN_RIVAL
    if decision.nameless_explains_more or is_nameless_rival:
        rivals.add(Verdict.UNKNOWN.value)
    return Finding(
        name=chosen.name,
        probability=probability,
        log_bayes_factor=chosen.log_bayes_factor,
        equivalent=tuple(sorted(rivals | set(effect.equivalent) | _alike_unseen(decision, effect))),
        magnitude=_magnitude(effect, value, sd),
        gap_closed=_closed(part),
        rms_before=budget.base,
        rms_after=budget.residual_with([*before, chosen.name]),
        shift=decision.shift,
        span=tuple(spans),
        detail=_detail(effect_term.shape, effect),
    )


def _alike_unseen(decision: Decision, effect: Effect) -> set[str]:
    """Names of effects of nearly the same power that the signals of the drives do not show."""
    known = frozenset[Quantity]().union(*(case.drive.known_quantities for case in decision.cases))
    return {name for name in effect.alike_unseen if not BY_NAME[name].usable_shapes(known)}


def _rivals(decision: Decision, chosen: ChosenEffect) -> tuple[set[str], float]:
    """Effects that may act in place of a chosen one, and the probability that it, or it or its rival, acts."""
    least = decision.thresholds.min_probability
    if chosen.probability >= least:
        return set(), chosen.probability
    if chosen.probability_with_rival >= least:
        return {chosen.rival}, chosen.probability_with_rival
    likely = {name for name, p in decision.result.probability.items() if p > MIN_RIVAL}
    return likely - {effect.name for effect in decision.result.chosen}, chosen.probability


def _candidate_finding(decision: Decision, ranked: RankedEffect, ranking: Sequence[RankedEffect]) -> Finding:
    drive_number, fitted = ranked.best
    effect_term, effect, base = fitted.term.effect_term, ranked.effect, decision.budget.base
    return Finding(
        name=ranked.name,
        probability=decision.result.probability[ranked.name],
        log_bayes_factor=ranked.gain,
        equivalent=tuple(sorted(_equivalent(decision, ranked, ranking))),
        magnitude=_magnitude(effect, fitted.value, fitted.sd),
        gap_closed=None,
        rms_before=base,
        rms_after=base,
        shift=None,
        span=() if effect_term is None else _log_spans(decision, drive_number, effect_term.spans or ()),
        detail="" if effect_term is None else _detail(effect_term.shape, effect),
    )


def _equivalent(decision: Decision, ranked: RankedEffect, ranking: Sequence[RankedEffect]) -> set[str]:
    """Names of effects that a drive cannot separate from a ranked one, or that the catalogue declares equivalent.

    They have evidence of their own and a trace with nearly the same course.
    """
    limits, (drive_number, fitted) = decision.thresholds, ranked.best
    others = [other for other in ranking if other is not ranked and other.gain > limits.min_log_bf_alike]
    others = [other for other in others if other.best[0] == drive_number]
    near = [o.name for o in others if _correlation(o.best[1].trace, fitted.trace) > limits.min_class_correlation]
    return {*near, *ranked.effect.equivalent, *_alike_unseen(decision, ranked.effect)}


def _unknown_finding(decision: Decision) -> Finding:
    """Finding of the unknown effect: the nameless processes beside the chosen effects."""
    budget, nameless = decision.budget, decision.nameless
    parts = [part for part in budget.parts if part.cause.startswith(UNKNOWN) and part.cause != WHITE]
    rms = float(np.sqrt(sum(part.rms**2 for part in parts))) if parts else float("nan")
    processes = nameless.term_by_drive
    names = [part.cause.removeprefix(UNKNOWN) for part in parts] or [next(iter(processes.values())).name]
    spans = [span for n, process in processes.items() for span in _log_spans(decision, n, process.spans or ())]
    return Finding(
        name=Verdict.UNKNOWN.value,
        probability=decision.probability_of_unknown,
        log_bayes_factor=decision.log_bf_unknown,
        equivalent=(),
        magnitude=Magnitude("rms", rms, float("nan"), "W"),
        gap_closed=None,
        rms_before=budget.base,
        rms_after=budget.base,
        shift=None,
        span=tuple(spans) if parts else (),
        detail=", ".join(_with_size(decision, name) for name in names),
    )


def _with_size(decision: Decision, name: str) -> str:
    """Name of a nameless process, with its size if it is a power or force that switches."""
    processes = decision.nameless.term_by_drive.items()
    switching = [(number, process) for number, process in processes if process.name == name]
    if name not in SWITCHES or not switching:
        return name
    number, process = switching[0]
    drive = decision.result.drives[number]
    size = drive.joint_with((process,)).posterior(range(len(drive.chosen) + 1)).mean[-1]
    shown = f"{size / 1e3:.1f} kW" if SWITCHES[name] == "W" else f"{size:,.0f} {SWITCHES[name]}"
    return f"{name} ({shown})"


def _log_spans(decision: Decision, number: int, spans: Spans) -> tuple[Span, ...]:
    """``spans`` [s] of the drive with this ``number``, in time since the first row of its log."""
    drive = decision.cases[number].drive
    return tuple(Span(a - drive.log_start, b - drive.log_start, drive.log) for a, b in spans)


def _slopes(drives: Sequence[DriveState]) -> tuple[float, float]:
    """Standard deviation [1] of the slope along the roads of all drives, and the sd of this value."""
    share = np.array([len(drive.fit.strides) for drive in drives]) / sum(len(drive.fit.strides) for drive in drives)
    sds = np.array([drive.slope_sd for drive in drives])
    independent = np.array([max(_length(drive) / SLOPE_LENGTH, 1.0) for drive in drives])
    doubt = np.array([drive.fit.slope_doubt for drive in drives]) / np.sqrt(independent)
    value = float(np.sqrt(share @ sds**2))
    by_noise = float(np.linalg.norm(share * sds * doubt)) / max(value, 1e-12)
    return value, float(np.hypot(by_noise, EFFECT_DOUBT * value))


def _length(drive: DriveState) -> float:
    """Length of the road driven [m], without gaps."""
    return float((drive.strides.s1 - drive.strides.s0).sum())


def _closed(part: Part | None) -> GapClosed | None:
    """Share of the gap beyond noise that the cause of a part takes, with its 90 % interval; None without a part."""
    return None if part is None else GapClosed(*part.closed)


def _correlation(x: Floats, y: Floats) -> float:
    """|Correlation| of two series (n,); 0 if one of them is constant."""
    if not (np.ptp(x) and np.ptp(y)):
        return 0.0
    return abs(float(np.corrcoef(x, y)[0, 1]))


def _magnitude(effect: Effect, value: float, sd: float) -> Magnitude:
    """Magnitude in the effect's unit, from the amplitude of its column and the sd of that."""
    if effect.magnitude_from_coefficient is None:
        return Magnitude(effect.symbol, value, sd, effect.unit)
    low, high = effect.magnitude_from_coefficient(value - sd), effect.magnitude_from_coefficient(value + sd)
    return Magnitude(effect.symbol, effect.magnitude_from_coefficient(value), abs(high - low) / 2, effect.unit)


def _detail(shape: object, effect: Effect) -> str:
    """The fitted shape in words; empty if there is none."""
    if isinstance(shape, Quantity):
        return shape.value
    return effect.describe(shape) if shape is not None and effect.describe is not None else ""

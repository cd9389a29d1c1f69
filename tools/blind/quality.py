"""Measures beyond the name: probabilities, gap closed, times, parameters and cost."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from harness.scores import Floats, bootstrap, calibration_error, rms, share

from blind import answer
from blind.case import Case, Measure, is_visible, share_of
from blind.truth import HIDDEN, key_of
from estimator.answers.diagnosis import Finding

MAX_SECONDS = 10.0  # s of processor time, the goal for a log of 75 minutes
SDS_OF_90_PERCENT = 1.645  # half-width of the central 90 % of a Gaussian, in sd
MAX_SHARE_ERROR = 0.03  # share of the gap: largest error of the share closed that counts as right


def probabilities(cases: Sequence[Case]) -> list[Measure]:
    """Credible sets and calibration of the probabilities, on all drives but those with two effects."""
    judged: list[Case] = []
    covered: dict[str, bool] = {}
    sizes, confidence, right = [], [], []
    for case in cases:
        chosen = answer.credible_set(case.run)
        if chosen is None or case.truth.kind == "pair":
            continue
        judged.append(case)
        covered[case.truth.drive] = any(_right(case, finding) for finding in chosen)
        if case.truth.kind == "single" and is_visible(case):
            sizes.append(len(chosen))
        confidence.append(min(max(chosen[0].probability or 0.0, 0.0), 1.0))
        right.append(float(_right(case, chosen[0])))
    return [
        share_of("90 % credible set covers", "88..95 %", judged, lambda c: covered[c.truth.drive]),
        statistic("median size of the credible set, oracle > 10", "<= 2", "", _median, sizes),
        statistic("expected calibration error", "<= 0.05", "", calibration_error, confidence, right),
    ]


def nothing_acts(case: Case) -> bool:
    """Whether the drive has no effect, or one that the oracle does not see or that is modelled by default."""
    return case.truth.log_bayes_factor < HIDDEN or case.truth.kind == "clean" or not case.has_gap


def _right(case: Case, finding: Finding) -> bool:
    """Whether a ranked candidate is the truth; "none" counts as true where the effect is invisible to the oracle."""
    truth = case.truth
    if finding.name == answer.NONE:
        return nothing_acts(case)
    if finding.name.startswith(answer.UNKNOWN):
        return truth.kind == "outside"
    return any(answer.means(finding, effect.name) for effect in truth.effects)


def gap_closed_and_times(cases: Sequence[Case]) -> list[Measure]:
    """Gap closed against the oracle's share, and times of bounded effects."""
    promised = []  # case, error of the share
    inside: dict[str, bool] = {}  # whether the interval of a single effect holds the oracle's share
    located = []
    for case in cases:
        truth, run = case.truth, case.run
        if truth.kind in ("clean", "outside") or not case.has_gap or not run.named or answer.invented(truth, run):
            continue
        hits = [e for e, hit in zip(truth.effects, answer.found(truth, run), strict=True) if hit]
        closed = [answer.closed_if_known(run, finding) for finding in run.named]
        fractions = [c.fraction for c in closed if c is not None and c.fraction is not None]
        if len(fractions) == len(run.named) and truth.stratum == "oracle > 10":
            oracle = truth.gap_closed[key_of(effect.world for effect in hits)]
            promised.append((case, min(sum(fractions), 1.0) - oracle))
            if len(fractions) == 1:
                inside[truth.drive] = any(c is not None and answer.holds(c, oracle) for c in closed)
        for effect in hits:
            if effect.spans:
                finding = next(f for f in run.named if answer.means(f, effect.name))
                located.append(answer.overlap(finding.span_s, effect.spans, truth.driven))
    errors = {case.truth.drive: abs(error) <= MAX_SHARE_ERROR for case, error in promised}
    judged = [case for case, _ in promised]
    single = [case for case in judged if case.truth.drive in inside]
    return [
        share_of("gap closed within 3 points of the oracle", ">= 95 %", judged, lambda c: errors[c.truth.drive]),
        share_of("its 90 % interval covers the oracle", "85..95 %", single, lambda c: inside[c.truth.drive]),
        statistic("median error of the gap closed", "small", "points", _median, [100 * error for _, error in promised]),
        statistic("localisation of bounded effects: median IoU", ">= 0.9", "", _median, located),
    ]


def parameters(cases: Sequence[Case]) -> list[Measure]:
    """Errors of A, C, m where the answer is right: all effects named, or none on clean drives."""
    lines = []
    good = [c for c in cases if c.truth.kind != "outside" and c.has_gap and c.run.answer is not None]
    good = [c for c in good if not answer.invented(c.truth, c.run) and all(answer.found(c.truth, c.run))]
    for key, label in (("mass_kg", "mass"), ("A_N", "A"), ("C_N_s2_m2", "C")):
        errors = []
        held: dict[str, bool] = {}
        for case in good:
            assert case.run.answer is not None
            said = case.run.answer.parameters
            value, sd = (None if part is None else getattr(part, key) for part in (said.final, said.sd))
            if value is not None:
                errors.append(100 * (value / case.truth.parameters[key] - 1.0))
            if value is not None and sd is not None:
                held[case.truth.drive] = abs(value - case.truth.parameters[key]) < SDS_OF_90_PERCENT * sd
        lines += [
            statistic(f"{label} with the right effects: {name} error", goal, "per cent", measure, errors)
            for name, goal, measure in (("median", "0 %", _median), ("rms", "small", rms))
        ]
        with_sd = [case.truth.drive for case in good if case.truth.drive in held]
        failures = tuple(drive for drive in with_sd if not held[drive])
        line = share(len(with_sd) - len(failures), len(with_sd))
        lines.append(
            Measure(name=f"its 90 % interval holds {label}", goal="85..95 %", estimate=line, failures=failures)
        )
    return lines


def cost(cases: Sequence[Case]) -> list[Measure]:
    """Time and memory of a diagnosis."""
    seconds = [case.run.processor_seconds for case in cases]
    peak = [case.run.peak_MB for case in cases if np.isfinite(case.run.peak_MB)]
    slow = tuple(case.truth.drive for case in cases if case.run.processor_seconds > MAX_SECONDS)
    return [
        replace(statistic("processor time for a log, median", "<= 10 s", "s", _median, seconds), failures=slow),
        statistic("processor time for a log, 95 % quantile", "<= 10 s", "s", _high, seconds),
        statistic("peak memory, largest", "-", "MB", np.max, peak),
    ]


def statistic(name: str, goal: str, unit: str, measure: Callable[..., float], *columns: Sequence[float]) -> Measure:
    """A measure of columns (n,) that is not a share."""
    estimate = bootstrap(measure, *(np.array(column, dtype=np.float64) for column in columns))
    return Measure(name=name, goal=goal, estimate=estimate, unit=unit)


def _median(x: Floats) -> float:
    return float(np.median(x))


def _high(x: Floats) -> float:
    return float(np.quantile(x, 0.95))

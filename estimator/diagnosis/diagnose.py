"""The diagnosis: where the gap lies, which effect causes it, how far it shrinks, and what is left."""

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np

from estimator.answers.diagnosis import Verdict
from estimator.diagnosis import facts
from estimator.diagnosis.base import parameter_sd
from estimator.diagnosis.conclusion import Conclusion, conclude
from estimator.diagnosis.described import described
from estimator.diagnosis.drive_data import Record
from estimator.diagnosis.experiment import experiments
from estimator.diagnosis.explanation import explain, started
from estimator.diagnosis.findings import Findings
from estimator.diagnosis.isolability import invisible, isolability, not_testable
from estimator.diagnosis.localisation import gap_map, places
from estimator.diagnosis.model import MIN_SAMPLES, Drive, Model, fit, select
from estimator.diagnosis.result import Diagnosis, Experiment, Finding, NotTestable, Shift, Traces
from estimator.diagnosis.surrogates import p_value
from estimator.diagnosis.thresholds import Thresholds
from estimator.estimation.moments import block_means
from estimator.estimation.road_fit import fit as fit_road
from estimator.estimation.shapes import fitted_with_shapes, is_free
from estimator.model.design_matrix import Term, best_terms, columns
from estimator.model.effects import CATALOGUE, Effect, obstacle
from estimator.signals import Floats, Quantity

SAMPLES_PER_SECOND = 10
MAX_EXPERIMENTS = 3  # pairs of effects that an experiment is looked for
PROBE_SEED = 20_043  # of the simulated noise in the correction of a fit that finds shapes
MIN_DRIVE = 300.0  # s of admitted driving: shorter drives seldom determine A, C and m


def diagnose(
    records: Sequence[Record],
    given: tuple[Effect, ...],
    rng: np.random.Generator,
    effects: Sequence[Effect] = CATALOGUE,
    thresholds: Thresholds | None = None,
    surrogates: int = 0,
) -> Diagnosis:
    """Diagnose one drive, or several of one vehicle.

    Parameters
    ----------
    records
        One of each drive.
    given
        Effects that are part of the model from the start.
    rng
        Of the bootstrap and of draws from posteriors.
    effects
        Candidates.
    thresholds
        Evidence that names an effect; None: the defaults.
    surrogates
        Records of noise alone that effects are looked for in as well, for a p-value.
    """
    limits = Thresholds() if thresholds is None else thresholds
    if records:
        effects = [effect for effect in effects if not all(effect.is_applied(record.known) for record in records)]
    plain: list[Drive] = []
    reason = "there is no driving in it"
    for record in records:
        drive = _start(record, given)
        if isinstance(drive, Drive):
            plain.append(drive)
        else:
            reason = drive
    missing = tuple(not_testable(effects, frozenset().union(*(record.known for record in records))))
    if not plain:
        return Diagnosis(verdict=Verdict.CANNOT_TELL, obstacle=_obstacle(records, reason), not_testable=missing)
    drives, states = started(plain)
    if not drives:
        reason = "less than half a minute of the drive shows force and speed without a gap"
        return Diagnosis(verdict=Verdict.CANNOT_TELL, obstacle=reason, not_testable=missing)
    conclusion = conclude(explain(drives, states, effects, limits), drives, limits, rng)
    found = _report(conclusion, effects, missing)
    return replace(found, p_value=p_value(conclusion.explained, surrogates, rng)) if surrogates else found


def _obstacle(records: Sequence[Record], reason: str) -> str:
    """Why no drive can be fitted: the ``reason`` of the last, unless all of several are too short."""
    minutes = [len(record.samples) / SAMPLES_PER_SECOND / 60 for record in records]
    if len(records) < 2 or max(minutes) >= MIN_DRIVE / 60:
        return reason
    return (
        f"of {len(records)} drives the longest has {max(minutes):.1f} minutes that can be used, all together "
        f"{sum(minutes):.1f}; each is fitted by itself, so it takes one of {MIN_DRIVE / 60:.0f} at least"
    )


def _start(record: Record, given: tuple[Effect, ...]) -> Drive | str:
    """The plain model on one drive, or why there is none."""
    samples = record.samples
    if len(samples) < MIN_SAMPLES:
        common = record.rejected.most_common(1)
        return "less than a minute of driving can be used" + (f"; most is: {common[0][0]}" if common else "")
    if len(samples) < MIN_DRIVE * SAMPLES_PER_SECOND:
        minutes, least = len(samples) / SAMPLES_PER_SECOND / 60, MIN_DRIVE / 60
        return f"only {minutes:.1f} minutes of driving can be used; it takes {least:.0f} at least"
    if reason := obstacle(given, record.known):
        return reason
    A, C, m = 1e3, 1.0, 1e4  # rough: used only to compare the shapes of an effect
    terms = _with_shapes(record, best_terms(given, samples, np.array([A, C, m])))
    kept = select(samples, terms)
    model = None if kept is None else fit(samples[kept], terms)
    if model is None or len(model.samples) < MIN_DRIVE * SAMPLES_PER_SECOND:
        return "speed and acceleration vary too little, or power is not positive, so A, C and m cannot be told apart"
    return Drive(record, model)


def _with_shapes(record: Record, terms: tuple[Term, ...]) -> tuple[Term, ...]:
    """The terms with the shapes of most evidence of the motion, where no signal tells these."""
    moving = [term for term in terms if not term.effect.is_gravity]
    if not any(is_free(term) for term in moving):
        return terms
    found = fitted_with_shapes(
        record.strides,
        tuple(moving),
        lambda terms, known: fit_road(record.strides, np.random.default_rng(PROBE_SEED), terms, known),
    )
    return terms if found is None else (*(term for term in terms if term.effect.is_gravity), *found.terms)


def _report(conclusion: Conclusion, effects: Sequence[Effect], missing: tuple[NotTestable, ...]) -> Diagnosis:
    """The diagnosis of a conclusion."""
    verdict, explained, longest = conclusion.verdict(), conclusion.explained, conclusion.longest
    findings = Findings(conclusion)
    named = findings.named()
    which = conclusion.explanation.which
    before = conclusion.plain[which].model
    after = conclusion.with_choices
    final, deviation = conclusion.road_load
    ranking = findings.candidates(named)
    told = {name for finding in named for name in (finding.name, *finding.equivalent)}
    others = [effect for effect in effects if effect.name not in told and not effect.is_gravity]
    forms = [form for one in explained.ranking if (form := one.each[which]) is not None]
    remaining = conclusion.remaining()
    return Diagnosis(
        verdict=verdict,
        effects=named,
        candidates=ranking,
        remaining_verdict=remaining,
        remaining_log_bayes_factor=conclusion.left_over,
        remainder=findings.remainder(),
        formula=described(longest) if remaining is Verdict.UNKNOWN or verdict is Verdict.UNKNOWN else None,
        doubtful=facts.doubtful(explained, verdict, named),
        noise_floor=conclusion.budget.floor,
        rms_base=conclusion.budget.base,
        rms_final=conclusion.budget.reached,
        base=_road_load(before.road_load),
        base_deviation=_deviation(before),
        final=final,
        deviation=deviation,
        where=tuple(places(before)),
        isolability=isolability(longest, forms),
        not_testable=missing,
        invisible=invisible(longest, others, conclusion.thresholds.min_expected_log_bf),
        advice=facts.advice(explained, effects, verdict, named),
        experiments=_experiments(conclusion, effects, verdict, named, ranking),
        streaming_effects=facts.streaming_effects(named, before.terms) if verdict is Verdict.EFFECT else (),
        budget=conclusion.budget,
        gap_map=gap_map(before, after[which].model),
        traces=_traces(conclusion.plain, after),
    )


def _experiments(
    conclusion: Conclusion,
    effects: Sequence[Effect],
    verdict: Verdict,
    named: Sequence[Finding],
    ranking: Sequence[Finding],
) -> tuple[Experiment, ...]:
    pairs = facts.unsettled(conclusion.explained, effects, verdict, named)
    evidence = {finding.name: finding.log_bayes_factor for finding in ranking}
    return experiments(conclusion.longest, pairs[:MAX_EXPERIMENTS], evidence)


def _road_load(parameters: Floats) -> Shift:
    A, C, m = parameters.tolist()
    return Shift(mass=m, A=A, C=C)


def _deviation(model: Model) -> Shift:
    return _road_load(np.array([parameter_sd(model.base, i) for i in range(3)]))


def _traces(plain: Sequence[Drive], final: Sequence[Drive]) -> Traces:
    """Means over a second."""
    parts: dict[str, list[Floats]] = {field.name: [] for field in fields(Traces)}
    for before, after in zip(plain, final, strict=True):
        samples = after.model.samples
        X, _ = columns(samples, before.model.terms, before.model.road_load)
        drive = Traces(
            t=samples.t - before.record.log_start,
            distance=samples.context[Quantity.DISTANCE],
            speed=samples.v,
            measured=samples.P,
            base=X @ before.model.base.theta,
            extended=samples.P - after.model.base.residual,
            log=np.full(len(samples), float(before.record.log)),
        )
        for name, part in parts.items():
            part.append(block_means(getattr(drive, name), SAMPLES_PER_SECOND))
    return Traces(**{name: np.concatenate(part) for name, part in parts.items()})

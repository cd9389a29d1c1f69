"""The diagnosis: where the gap lies, which effect causes it, how far it shrinks, and what is left."""

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np

from estimator.answers.diagnosis import Verdict
from estimator.diagnosis import facts, findings
from estimator.diagnosis.averaged_residual import averages_of
from estimator.diagnosis.averaging import averaged
from estimator.diagnosis.beside_road import BesideRoad, beside_road
from estimator.diagnosis.candidates import assess
from estimator.diagnosis.described import described
from estimator.diagnosis.drive_data import Record
from estimator.diagnosis.evidence import parameter_sd
from estimator.diagnosis.experiment import experiments
from estimator.diagnosis.isolability import invisible, isolability, not_testable
from estimator.diagnosis.localisation import gap_map, places
from estimator.diagnosis.model import MIN_SAMPLES, Model, fit, select
from estimator.diagnosis.multi_drive import Drive
from estimator.diagnosis.outcome import Outcome
from estimator.diagnosis.result import Diagnosis, Experiment, Finding, Invisible, NotTestable, Shift, Traces
from estimator.diagnosis.search import search
from estimator.diagnosis.surrogates import p_value
from estimator.diagnosis.thresholds import Thresholds
from estimator.estimation.moments import block_means
from estimator.model.design_matrix import best_terms, columns
from estimator.model.effects import CATALOGUE, Effect
from estimator.signals import Floats, Quantity

SAMPLES_PER_SECOND = 10
MAX_EXPERIMENTS = 3  # pairs of effects that an experiment is looked for
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
        Records of noise alone that effects are looked for in as well, for a p-value; none on hills.
    """
    limits = Thresholds() if thresholds is None else thresholds
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
    result = search(tuple(plain), effects, limits)
    outcome = Outcome(result=result, plain=tuple(plain), effects=effects, rng=rng, thresholds=limits)
    return _report(outcome, missing, surrogates)


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
        return f"only {len(samples) / SAMPLES_PER_SECOND / 60:.1f} minutes of driving can be used; it takes 5 at least"
    for effect in given:
        if not effect.streaming_shapes(record.known):
            return f"the effect {effect.name} needs {' or '.join(r.value for r in effect.wanted)}, which the bus lacks"
    A, C, m = 1e3, 1.0, 1e4  # rough: used only to compare the shapes of an effect
    terms = best_terms(given, samples, np.array([A, C, m]))
    kept = select(samples, terms)
    model = None if kept is None else fit(samples[kept], terms)
    if model is None or len(model.samples) < MIN_DRIVE * SAMPLES_PER_SECOND:
        return "speed and acceleration vary too little, or power is not positive, so A, C and m cannot be told apart"
    return Drive(record, model)


def _report(outcome: Outcome, missing: tuple[NotTestable, ...], surrogates: int) -> Diagnosis:
    """The diagnosis of a finished search, with the road as a state where it can be fitted."""
    verdict, late, hills = outcome.verdict, findings.lag(outcome), findings.hidden_grade(outcome)
    if late is not None and verdict in (Verdict.NO_GAP, Verdict.CANNOT_TELL) and not outcome.result.chosen:
        verdict = Verdict.EFFECT
    beside = beside_road(outcome)
    found = (hills, *findings.chosen(outcome), late)
    ranking = findings.ranking(outcome, late)
    if beside is not None and beside.is_on_hills:
        verdict, found = beside.verdict(), (*beside.findings(found), late)
        ranking = beside.candidates([finding for finding in found if finding is not None])
    named = tuple(f for f in found if f is not None) if verdict in (Verdict.EFFECT, Verdict.CANNOT_TELL) else ()
    before, after = (drives[outcome.longest].model for drives in (outcome.plain, outcome.final))
    candidates = [c for joint in outcome.result.ranking if (c := joint.each[outcome.longest]) is not None]
    diagnosis = Diagnosis(
        verdict=verdict,
        effects=named,
        candidates=ranking,
        remainder=facts.remainder(outcome),
        doubtful=facts.doubtful(outcome, verdict, named),
        base=_road_load(before.road_load),
        base_deviation=_deviation(before),
        where=tuple(places(before)),
        isolability=isolability(candidates, before),
        not_testable=missing,
        invisible=_unseen(outcome, beside, named),
        advice=facts.advice(outcome, verdict, named),
        experiments=() if beside is None else _experiments(beside, facts.unsettled(outcome, verdict, named), ranking),
        streaming_effects=facts.streaming_effects(named, before.terms) if verdict is Verdict.EFFECT else (),
        budget=None if beside is None else beside.budget,
        gap_map=gap_map(before, after),
        traces=_traces(outcome),
    )
    if beside is not None and beside.is_on_hills:
        return _with_road(diagnosis, beside, outcome.thresholds.min_log_bf_left_process)
    known = _with_known_road(diagnosis, outcome, hills is not None)
    return known if hills is not None or not surrogates else replace(known, p_value=_p_value(outcome, surrogates))


def _unseen(outcome: Outcome, beside: BesideRoad | None, named: Sequence[Finding]) -> tuple[Invisible, ...]:
    """Effects that could act without evidence, by the model that judged the others."""
    told = {finding.name for finding in named}
    others = [effect for effect in outcome.effects if effect.name not in told]
    if beside is not None and beside.is_on_hills:
        return beside.invisible([effect for effect in others if not effect.is_gravity])
    drive = outcome.final[outcome.longest]
    model, known = drive.model, drive.record.known
    at_last = assess(model, averages_of(model), outcome.effects, known, drive.rest)
    return tuple(invisible(others, at_last, model, known, outcome.thresholds))


def _experiments(
    beside: BesideRoad, pairs: Sequence[tuple[Effect, Effect | None]], ranking: Sequence[Finding]
) -> tuple[Experiment, ...]:
    evidence = {finding.name: finding.log_bayes_factor for finding in ranking}
    return experiments(beside.longest, pairs[:MAX_EXPERIMENTS], evidence)


def _p_value(outcome: Outcome, surrogates: int) -> float:
    ranking, final = outcome.result.ranking, outcome.final
    return p_value(ranking, final, outcome.effects, outcome.thresholds, surrogates, outcome.rng)


def _with_road(diagnosis: Diagnosis, beside: BesideRoad, min_log_bf: float) -> Diagnosis:
    """The diagnosis with residuals and parameters of the model that has the road as a state."""
    final, deviation = beside.road_load
    left = beside.left_over
    return replace(
        diagnosis,
        remaining_verdict=Verdict.UNKNOWN if left > min_log_bf else Verdict.NO_GAP,
        remaining_log_bayes_factor=left,
        noise_floor=beside.budget.floor,
        rms_base=beside.rms_base,
        rms_final=beside.budget.reached,
        final=final,
        deviation=deviation,
    )


def _with_known_road(diagnosis: Diagnosis, outcome: Outcome, hidden: bool) -> Diagnosis:
    """The diagnosis with residuals and parameters of the road load and the chosen effects."""
    mean, deviation = averaged(outcome.final[outcome.longest], outcome.thresholds)
    left = outcome.left.log_bayes_factor
    remaining = Verdict.NO_GAP
    if left > outcome.thresholds.min_log_bf_left_process:
        remaining = Verdict.CANNOT_TELL if outcome.is_altimeter_error else Verdict.UNKNOWN
    return replace(
        diagnosis,
        remaining_verdict=Verdict.CANNOT_TELL if hidden else remaining,
        remaining_log_bayes_factor=None if hidden else left,
        formula=described(outcome.final[outcome.longest].model) if remaining is Verdict.UNKNOWN else None,
        noise_floor=float(np.sqrt(outcome.floor)),
        rms_base=outcome.steps[0].rms,
        rms_final=outcome.steps[-1].rms,
        final=_road_load(mean),
        deviation=_road_load(deviation),
    )


def _road_load(parameters: Floats) -> Shift:
    A, C, m = parameters.tolist()
    return Shift(mass=m, A=A, C=C)


def _deviation(model: Model) -> Shift:
    return _road_load(np.array([parameter_sd(model.base, i) for i in range(3)]))


def _traces(outcome: Outcome) -> Traces:
    """Means over a second."""
    parts: dict[str, list[Floats]] = {field.name: [] for field in fields(Traces)}
    for before, after in zip(outcome.plain, outcome.final, strict=True):
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

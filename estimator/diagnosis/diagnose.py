"""The diagnosis: where the gap lies, which effect causes it, how far it shrinks, and what is left."""

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from estimator.diagnosis import findings, words
from estimator.diagnosis.averaging import averaged
from estimator.diagnosis.candidates import assess
from estimator.diagnosis.evidence import parameter_sd
from estimator.diagnosis.grains import grains_of
from estimator.diagnosis.isolability import invisible, isolability, not_testable
from estimator.diagnosis.joint import Drive
from estimator.diagnosis.model import FEWEST, Model, fit, select
from estimator.diagnosis.outcome import Outcome
from estimator.diagnosis.record import Record
from estimator.diagnosis.result import Diagnosis, NotTestable, Shift, Traces, Verdict
from estimator.diagnosis.search import search
from estimator.diagnosis.thresholds import UNEXPLAINED
from estimator.diagnosis.where import gap_map, places
from estimator.effects import CATALOGUE, Effect
from estimator.estimation.columns import best_terms, columns
from estimator.estimation.moments import block_means
from estimator.signals import Floats, Quantity

SECOND = 10  # samples
SHORTEST = 300.0  # s of admitted driving


def diagnose(
    records: Sequence[Record],
    given: tuple[Effect, ...],
    rng: np.random.Generator,
    effects: Sequence[Effect] = CATALOGUE,
) -> Diagnosis:
    """Diagnose one drive, or several of one vehicle; ``given`` effects are part of the model from the start."""
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
        return Diagnosis(Verdict.CANNOT_TELL, f"Cannot tell: {reason}.", not_testable=missing)
    return _report(Outcome(search(tuple(plain), effects), tuple(plain), effects, rng), missing)


def _start(record: Record, given: tuple[Effect, ...]) -> Drive | str:
    """The plain model on one drive, or why there is none."""
    samples = record.samples
    if len(samples) < FEWEST:
        common = record.rejected.most_common(1)
        return "less than a minute of driving can be used" + (f"; most is: {common[0][0]}" if common else "")
    if len(samples) < SHORTEST * SECOND:
        return f"only {len(samples) / SECOND / 60:.1f} minutes of driving can be used; it takes 5 at least"
    for effect in given:
        if not effect.streaming_shapes(record.known):
            return f"the effect {effect.name} needs {' or '.join(r.value for r in effect.wanted)}, which the bus lacks"
    A, C, m = 1e3, 1.0, 1e4  # of no weight: only the best of several shapes is looked for
    terms = best_terms(given, samples, np.array([A, C, m]))
    kept = select(samples, terms)
    model = None if kept is None else fit(samples[kept], terms)
    if model is None or len(model.samples) < SHORTEST * SECOND:
        return "speed and acceleration vary too little, or power is not positive, so A, C and m cannot be told apart"
    return Drive(record, model)


def _report(outcome: Outcome, missing: tuple[NotTestable, ...]) -> Diagnosis:
    """Put together."""
    verdict, late, hills = outcome.verdict, findings.lag(outcome), findings.hidden_grade(outcome)
    if late is not None and verdict in (Verdict.NO_GAP, Verdict.CANNOT_TELL) and not outcome.result.chosen:
        verdict = Verdict.EFFECT
    found = tuple(f for f in (hills, *findings.chosen(outcome), late) if f is not None)
    named = found if verdict in (Verdict.EFFECT, Verdict.CANNOT_TELL) else ()
    drive, plain = outcome.final[outcome.longest], outcome.plain[outcome.longest]
    before, after, left = plain.model, drive.model, outcome.left.log_bayes_factor
    mean, deviation = averaged(drive)
    at_last = assess(after, grains_of(after), outcome.effects, drive.record.known, drive.rest)
    unseen = tuple(invisible(outcome.effects, at_last, after, drive.record.known))
    candidates = [c for joint in outcome.result.ranking if (c := joint.each[outcome.longest]) is not None]
    remaining = Verdict.NO_GAP
    if left > UNEXPLAINED:
        remaining = Verdict.CANNOT_TELL if outcome.rough_hills else Verdict.UNKNOWN
    return Diagnosis(
        verdict,
        words.reason(outcome, verdict, named, unseen),
        named,
        findings.ranking(outcome, late),
        remaining if hills is None else Verdict.CANNOT_TELL,
        left if hills is None else None,
        float(np.sqrt(outcome.floor)),
        outcome.steps[0].rms,
        outcome.steps[-1].rms,
        _road_load(before.road_load),
        _deviation(before),
        _road_load(mean),
        _road_load(deviation),
        tuple(places(before)),
        isolability(candidates, before),
        missing,
        unseen,
        words.advice(outcome, verdict, named),
        words.configuration(named, before.terms),
        gap_map(before, after),
        _traces(outcome),
    )


def _road_load(parameters: Floats) -> Shift:
    A, C, m = parameters.tolist()
    return Shift(mass=m, A=A, C=C)


def _deviation(model: Model) -> Shift:
    return _road_load(np.array([parameter_sd(model.base, i) for i in range(3)]))


def _traces(outcome: Outcome) -> Traces:
    """Means over a second."""
    parts: list[list[Floats]] = [[] for _ in fields(Traces)]
    for before, after in zip(outcome.plain, outcome.final, strict=True):
        samples = after.model.samples
        X, _ = columns(samples, before.model.terms, before.model.road_load)
        base, extended = X @ before.model.base.theta, samples.P - after.model.base.residual
        t, distance = samples.t - before.record.log_start, samples.context[Quantity.DISTANCE]
        log = np.full(len(samples), float(before.record.log))
        for part, array in zip(parts, (t, distance, samples.v, samples.P, base, extended, log), strict=True):
            part.append(block_means(array, SECOND))
    return Traces(*(np.concatenate(part) for part in parts))

"""The findings of a search, one for each effect: chosen, ranked, a lag, or a hidden grade."""

from dataclasses import replace

import numpy as np

from estimator.answers.diagnosis import Verdict
from estimator.diagnosis.candidates import Candidate
from estimator.diagnosis.excess_lag import excess_lag
from estimator.diagnosis.held_out import gap_closed
from estimator.diagnosis.hidden_grade import grade_sd
from estimator.diagnosis.model import Model, fit
from estimator.diagnosis.multi_drive import Drive, is_same_class
from estimator.diagnosis.outcome import Outcome, alike, ties
from estimator.diagnosis.processes import Leftover
from estimator.diagnosis.result import HIDDEN_GRADE, Finding, GapClosed, Magnitude, Shift, Span
from estimator.diagnosis.search import Found
from estimator.model.design_matrix import Spans, Term
from estimator.model.effects import BY_NAME, Timing
from estimator.signals import Quantity

HILL_SAMPLES = 300.0  # samples, 30 s, after which the road has another grade
SDS_OF_90_PERCENT = 1.645  # standard deviations to either side that hold 90 % of a Gaussian


def chosen(outcome: Outcome) -> tuple[Finding, ...]:
    """The effects that were added, in that order."""
    return tuple(_chosen(outcome, i, found) for i, found in enumerate(outcome.result.chosen))


def _chosen(outcome: Outcome, i: int, found: Found) -> Finding:
    joint, before, after = found.joint, outcome.steps[i], outcome.steps[i + 1]
    which, candidate = joint.best
    final = outcome.final[which].model
    term = next((t for t in final.terms if t.effect.name == joint.name), candidate.term)
    earlier = outcome.final[which].without(joint.name).model
    return Finding(
        name=joint.name,
        probability=outcome.probability(found),
        log_bayes_factor=joint.log_bayes_factor,
        equivalent=(*alike(found, outcome.thresholds), *ties(found, outcome.thresholds)),
        magnitude=_magnitude(final, candidate),
        gap_closed=gap_closed(before, after, outcome.floor, outcome.doubt, outcome.rng),
        rms_before=before.rms,
        rms_after=after.rms,
        shift=difference(earlier, final),
        span=_acting(outcome, joint.name),
        detail=_detail(term),
    )


def _acting(outcome: Outcome, name: str) -> tuple[Span, ...]:
    """When an effect acts in the final models of all drives."""
    found = [(drive, term) for drive in outcome.final for term in drive.model.terms if term.effect.name == name]
    return tuple(span for drive, term in found for span in _clock(drive, term.spans or ()))


def _clock(drive: Drive, spans: Spans) -> tuple[Span, ...]:
    record = drive.record
    return tuple(Span(a - record.log_start, b - record.log_start, record.log) for a, b in spans)


def _magnitude(model: Model, candidate: Candidate) -> Magnitude:
    """Value in the final ``model``, with the sd of the candidate."""
    effect = candidate.term.effect
    values = {term.effect.name: value for term, value in zip(model.terms, model.magnitudes, strict=True)}
    return Magnitude(effect.symbol, values.get(effect.name, candidate.value), candidate.sd, effect.unit)


def _detail(term: Term) -> str:
    """The shape found, in words."""
    if isinstance(term.shape, Quantity):
        return term.shape.value
    if term.shape is not None and term.effect.describe is not None:
        return term.effect.describe(term.shape)
    if term.effect.timing is Timing.SWITCHING and term.spans:
        return f"{len(term.spans)} times on"
    return ""


def difference(before: Model, after: Model) -> Shift:
    """Change of the road load [A, C, m] from one model to another."""
    A, C, m = (after.road_load - before.road_load).tolist()
    return Shift(mass=m, A=A, C=C)


def lag(outcome: Outcome) -> Finding | None:
    """The lag between power and speed, where it is beyond usual delays; the alignment has removed it."""
    drive = outcome.final[outcome.longest]
    late = excess_lag(drive, outcome.thresholds)
    if late is None:
        return None
    plain = fit(late.unaligned, drive.model.terms)
    effect = BY_NAME["time_lag" if late.lag > 0 else "speed_filter"]
    return Finding(
        name=effect.name,
        probability=outcome.thresholds.probabilities([late.log_bayes_factor])[0],
        log_bayes_factor=late.log_bayes_factor,
        equivalent=effect.equivalent,
        magnitude=Magnitude(effect.symbol, late.lag, late.sd, effect.unit),
        gap_closed=gap_closed(
            late.before, late.after, min(outcome.floor, late.after.mean_square), outcome.doubt, outcome.rng
        ),
        rms_before=late.before.rms,
        rms_after=late.after.rms,
        shift=None if plain is None else difference(plain, drive.model),
        detail="taken out by the alignment",
    )


def hidden_grade(outcome: Outcome) -> Finding | None:
    """A grade that no signal shows; its share of the gap is what a signal could close."""
    force = outcome.grade
    if force is None:
        return None
    before = outcome.steps[-1]
    sd = grade_sd(force, outcome.plain)
    spread = float(
        np.sqrt(2 / max(len(outcome.final[outcome.longest].model.samples) / HILL_SAMPLES, 1.0))
    )  # of a variance
    return Finding(
        name="grade",
        probability=outcome.thresholds.probabilities(
            [force.log_bayes_factor, *(joint.log_bayes_factor for joint in outcome.result.ranking)]
        )[0],
        log_bayes_factor=force.log_bayes_factor,
        equivalent=(),
        magnitude=Magnitude(HIDDEN_GRADE, sd, sd * spread / 2, "1"),
        gap_closed=_promised(outcome, force, spread),
        rms_before=before.rms,
        rms_after=float(np.sqrt(outcome.floor)),
        shift=None,
        detail="varies with place; no signal on the bus shows it",
    )


def _promised(outcome: Outcome, force: Leftover, spread: float) -> GapClosed:
    """Share of the gap that a signal of the grade could close: at most all of it, at least the part that is a force."""
    gap = outcome.steps[-1].mean_square - outcome.floor
    if gap <= 0:
        return GapClosed(0.0, 0.0, 1.0)
    return GapClosed(1.0, float(np.clip(force.variance * (1 - SDS_OF_90_PERCENT * spread) / gap, 0.0, 1.0)), 1.0)


def ranking(outcome: Outcome, late: Finding | None) -> tuple[Finding, ...]:
    """All candidates against the plain model, and the best process without a name."""
    joints, process = outcome.result.ranking, outcome.result.at_first[0]
    evidence = [joint.log_bayes_factor for joint in joints]
    lag_evidence = [] if late is None else [late.log_bayes_factor]
    shares = outcome.thresholds.probabilities([*evidence, process.log_bayes_factor, *lag_evidence])
    rms = outcome.steps[0].rms
    listed = []
    for joint, share in zip(joints, shares, strict=False):
        which, candidate = joint.best
        term = candidate.term
        same = tuple(
            sorted(
                other.name for other in joints if other is not joint and is_same_class(joint, other, outcome.thresholds)
            )
        )
        size = Magnitude(term.effect.symbol, candidate.value, candidate.sd, term.effect.unit)
        spans = _clock(outcome.plain[which], term.spans or ())
        value = joint.log_bayes_factor
        listed.append(
            Finding(
                name=joint.name,
                probability=share,
                log_bayes_factor=value,
                equivalent=same,
                magnitude=size,
                gap_closed=None,
                rms_before=rms,
                rms_after=rms,
                shift=None,
                span=spans,
                detail=_detail(term),
            )
        )
    size = Magnitude("rms", float(np.sqrt(process.variance)), float("nan"), "W")
    name = Verdict.UNKNOWN.value if outcome.grade is None else "grade"
    value = process.log_bayes_factor
    listed.append(
        Finding(
            name=name,
            probability=shares[len(joints)],
            log_bayes_factor=value,
            equivalent=(),
            magnitude=size,
            gap_closed=None,
            rms_before=rms,
            rms_after=rms,
            shift=None,
            span=(),
            detail=process.name,
        )
    )
    if late is not None:
        listed.append(replace(late, probability=shares[len(joints) + 1]))
    return tuple(sorted(listed, key=lambda finding: -finding.log_bayes_factor))

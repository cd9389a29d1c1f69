"""What was found, effect by effect: chosen, ranked, or seen by the alignment."""

from dataclasses import replace

import numpy as np

from estimator.diagnosis.candidates import Candidate
from estimator.diagnosis.evidence import parameter_sd
from estimator.diagnosis.hills import grade_sd
from estimator.diagnosis.joint import same_class
from estimator.diagnosis.model import Model, fit
from estimator.diagnosis.outcome import Outcome, alike, ties
from estimator.diagnosis.result import Finding, GapClosed, Magnitude, Shift, Verdict
from estimator.diagnosis.search import Found
from estimator.diagnosis.shrinkage import gap_closed, held_out
from estimator.diagnosis.thresholds import NAMED, probabilities
from estimator.effects import BY_NAME, Timing
from estimator.estimation.columns import PLAIN, Spans, Term
from estimator.signals import Quantity

ORDINARY_LAG = (-0.06, 0.12)  # s, of power behind speed: torque takes longer to the bus
SURE_LAG = 4.0  # sd beyond it
CORRELATED = 4.0  # residuals of 2 s that count as one
HILL = 300.0  # samples in which the road changes its grade
HIDDEN_GRADE = "sd of the grade"


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
        joint.name,
        outcome.probability(found),
        joint.log_bayes_factor,
        (*alike(found), *ties(found)),
        _magnitude(final, candidate),
        gap_closed(before, after, outcome.floor, outcome.doubt, outcome.rng),
        before.rms,
        after.rms,
        difference(earlier, final),
        _clock(outcome, which, term.spans or ()),
        _detail(term),
    )


def _clock(outcome: Outcome, which: int, spans: Spans) -> Spans:
    start = outcome.plain[which].record.start
    return tuple((a - start, b - start) for a, b in spans)


def _magnitude(model: Model, candidate: Candidate) -> Magnitude:
    """As the final model has it, with the uncertainty with which it was first found."""
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
    """A lag between power and speed that no sensor's ordinary delay explains; the alignment has taken it out."""
    drive = outcome.final[outcome.longest]
    model, s = drive.model, drive.model.samples
    late = drive.record.lag + float(model.base.theta[PLAIN - 1])
    sd = parameter_sd(model.base, PLAIN - 1)
    if max(late - ORDINARY_LAG[1], ORDINARY_LAG[0] - late) < SURE_LAG * sd:
        return None
    # As if nobody had aligned: the power of lag seconds ago, to first order, and no column for its rate.
    unaligned = replace(s, P=s.P - late * s.dP)
    before = held_out(unaligned, model.terms, model.road_load, lagged=False)
    after = held_out(s, model.terms, model.road_load)
    evidence = len(before.squares) / 2 * float(np.log(before.mean_square / after.mean_square)) / CORRELATED
    if evidence < NAMED:
        return None
    plain = fit(unaligned, model.terms)
    effect = BY_NAME["time_lag" if late > 0 else "speed_filter"]
    return Finding(
        effect.name,
        probabilities([evidence])[0],
        evidence,
        effect.equivalent,
        Magnitude(effect.symbol, late, sd, effect.unit),
        gap_closed(before, after, min(outcome.floor, after.mean_square), outcome.doubt, outcome.rng),
        before.rms,
        after.rms,
        None if plain is None else difference(plain, model),
        detail="taken out by the alignment",
    )


def hidden_grade(outcome: Outcome) -> Finding | None:
    """A grade that no signal shows; its share of the gap is what a signal could close."""
    force = outcome.grade
    if force is None:
        return None
    before = outcome.steps[-1]
    sd = grade_sd(force, outcome.plain)
    hills = max(len(outcome.final[outcome.longest].model.samples) / HILL, 1.0)
    return Finding(
        "grade",
        probabilities([force.log_bayes_factor, *(joint.log_bayes_factor for joint in outcome.result.ranking)])[0],
        force.log_bayes_factor,
        (),
        Magnitude(HIDDEN_GRADE, sd, sd / float(np.sqrt(2 * hills)), "1"),
        GapClosed(1.0 if before.mean_square > outcome.floor else 0.0, float("nan"), float("nan")),
        before.rms,
        float(np.sqrt(outcome.floor)),
        None,
        detail="goes with the place; no signal on the bus shows it",
    )


def ranking(outcome: Outcome, late: Finding | None) -> tuple[Finding, ...]:
    """All candidates against the plain model, and the best process without a name."""
    joints, process = outcome.result.ranking, outcome.result.at_first[0]
    evidence = [joint.log_bayes_factor for joint in joints]
    shares = probabilities([*evidence, process.log_bayes_factor, *([] if late is None else [late.log_bayes_factor])])
    rms = outcome.steps[0].rms
    listed = []
    for joint, share in zip(joints, shares, strict=False):
        which, candidate = joint.best
        term = candidate.term
        same = tuple(sorted(other.name for other in joints if other is not joint and same_class(joint, other)))
        size = Magnitude(term.effect.symbol, candidate.value, candidate.sd, term.effect.unit)
        spans = _clock(outcome, which, term.spans or ())
        value = joint.log_bayes_factor
        listed.append(Finding(joint.name, share, value, same, size, None, rms, rms, None, spans, _detail(term)))
    size = Magnitude("rms", float(np.sqrt(process.variance)), float("nan"), "W")
    name = Verdict.UNKNOWN.value if outcome.grade is None else "grade"
    value = process.log_bayes_factor
    listed.append(Finding(name, shares[len(joints)], value, (), size, None, rms, rms, None, (), process.name))
    if late is not None:
        listed.append(replace(late, probability=shares[len(joints) + 1]))
    return tuple(sorted(listed, key=lambda finding: -finding.log_bayes_factor))

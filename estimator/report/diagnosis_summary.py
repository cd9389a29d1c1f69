"""The answer of `roadload diagnose`; powers in kW, all else in the units that the keys name."""

import math

from estimator.answers import diagnosis as answer
from estimator.answers.diagnosis import DiagnosisAnswer
from estimator.components.budget import Part
from estimator.diagnosis.result import Diagnosis, Finding, Invisible, Isolability, Place, ResidualFormula, Shift
from estimator.report import wording


def of_diagnosis(d: Diagnosis) -> DiagnosisAnswer:
    """A whole diagnosis."""
    return DiagnosisAnswer(
        verdict=d.verdict,
        reason=wording.reason(d),
        given=d.given,
        configuration=wording.configuration(d),
        effects=tuple(map(_finding, d.effects)),
        candidates=tuple(map(_finding, d.candidates)),
        remaining=answer.Remaining(
            verdict=d.remaining_verdict, log_bayes_factor=d.remaining_log_bayes_factor, formula=_formula(d.formula)
        ),
        noise_floor_kW=_kilowatts(d.noise_floor),
        rms_base_kW=_kilowatts(d.rms_base),
        rms_final_kW=_kilowatts(d.rms_final),
        budget=() if d.budget is None else tuple(map(_part, d.budget.parts)),
        parameters=answer.Parameters(
            base=_road_load(d.base),
            base_sd=_road_load(d.base_deviation),
            final=_road_load(d.final),
            sd=_road_load(d.deviation),
            log=None if d.longest is None else d.longest.log,
            span_s=None if d.longest is None else (d.longest.start, d.longest.end),
        ),
        where=tuple(map(_place, d.where)),
        isolability=answer.Isolability() if d.isolability is None else _isolability(d.isolability),
        not_testable=tuple(answer.NotTestable(name=n.name, needs=n.needs) for n in d.not_testable),
        invisible=tuple(map(_invisible, d.invisible)),
        advice=tuple(wording.advice(d)),
        experiments=tuple(
            answer.Experiment(a=e.a, b=e.b, what=e.what, minutes=e.minutes, now=e.now, expected=e.expected)
            for e in d.experiments
        ),
        p_value=d.p_value,
        logs=d.logs,
        doubts=d.doubts,
        references=d.references,
    )


def _formula(f: ResidualFormula | None) -> answer.Formula | None:
    if f is None:
        return None
    return answer.Formula(
        text=f.text, value=f.value, sd=f.sd, unit=f.unit, log_bayes_factor=f.log_bayes_factor, share=f.share
    )


def _finding(f: Finding) -> answer.Finding:
    closed, size = f.gap_closed, f.magnitude
    return answer.Finding(
        name=f.name,
        probability=f.probability,
        log_bayes_factor=f.log_bayes_factor,
        equivalent=f.equivalent,
        magnitude=answer.Magnitude(name=size.name, value=size.value, sd=size.sd, unit=size.unit),
        gap_closed=None
        if closed is None
        else answer.GapClosed(fraction=closed.fraction, q05=closed.q05, q95=closed.q95),
        rms_before_kW=_kilowatts(f.rms_before),
        rms_after_kW=_kilowatts(f.rms_after),
        parameter_shift=_road_load(f.shift),
        span_s=tuple((span.start, span.end) for span in f.span),
        span_log=tuple(span.log for span in f.span),
        detail=f.detail,
    )


def _part(part: Part) -> answer.Part:
    return answer.Part(
        cause=part.cause,
        given=part.is_given,
        share=part.share,
        q05=part.q05,
        q95=part.q95,
        rms_kW=_kilowatts(part.rms),
        reached_kW=_kilowatts(part.held_out_rms),
        expected_kW=_kilowatts(part.expected),
    )


def _place(place: Place) -> answer.Place:
    return answer.Place(
        axis=place.axis,
        start=place.start,
        end=place.end,
        unit=place.unit,
        bias_kW=_kilowatts(place.bias),
        share=place.share,
        q_value=place.q_value,
    )


def _isolability(of: Isolability) -> answer.Isolability:
    pairs = []
    for i, a in enumerate(of.names):
        for j in range(i + 1, len(of.names)):
            r = float(of.correlation[i, j])
            distance = math.sqrt(max(1 - r * r, 0.0))
            pairs.append(answer.Pair(a=a, b=of.names[j], distance=distance, correlation=r))
    visibility = (
        answer.Visibility(name=name, expected_log_bayes_factor=expected)
        for name, expected in zip(of.names, of.expected_log_bayes_factor.tolist(), strict=True)
    )
    return answer.Isolability(pairs=tuple(pairs), visibility=tuple(visibility))


def _invisible(effect: Invisible) -> answer.Invisible:
    return answer.Invisible(
        name=effect.name,
        expected_log_bayes_factor=effect.expected_log_bayes_factor,
        parameter_shift=_road_load(effect.shift),
        breaks=effect.shown_by,
    )


def _road_load(p: Shift | None) -> answer.RoadLoad | None:
    return None if p is None else answer.RoadLoad(mass_kg=p.mass, A_N=p.A, C_N_s2_m2=p.C)


def _kilowatts(watts: float | None) -> float | None:
    return None if watts is None else watts / 1e3

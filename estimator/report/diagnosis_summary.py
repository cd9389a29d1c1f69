"""The JSON that `roadload diagnose` prints: keys that other programs rely on; what is not known is null."""

import math
from typing import Any

from estimator.components.budget import Part
from estimator.diagnosis.result import Diagnosis, Finding, Isolability, Shift
from estimator.report import wording


def of_diagnosis(d: Diagnosis) -> dict[str, Any]:
    """One object for a whole diagnosis; powers in kW, all else in the units that the keys name."""
    return {
        "verdict": d.verdict.value,
        "reason": wording.reason(d),
        "configuration": wording.configuration(d),
        "effects": [_finding(f) for f in d.effects],
        "candidates": [_finding(f) for f in d.candidates],
        "remaining": {
            "verdict": d.remaining_verdict.value,
            "log_bayes_factor": _number(d.remaining_log_bayes_factor),
        },
        "noise_floor_kW": _kilowatts(d.noise_floor),
        "rms_base_kW": _kilowatts(d.rms_base),
        "rms_final_kW": _kilowatts(d.rms_final),
        "budget": [] if d.budget is None else [_part(part) for part in d.budget.parts],
        "parameters": {
            "base": _parameters(d.base),
            "base_sd": _parameters(d.base_deviation),
            "final": _parameters(d.final),
            "sd": _parameters(d.deviation),
        },
        "where": [
            {
                "axis": place.axis,
                "from": _number(place.start),
                "to": _number(place.end),
                "unit": place.unit,
                "bias_kW": _kilowatts(place.bias),
                "share": _number(place.share),
                "q_value": _number(place.q_value),
            }
            for place in d.where
        ],
        "isolability": {"pairs": [], "visibility": []} if d.isolability is None else _isolability(d.isolability),
        "not_testable": [{"name": n.name, "needs": n.needs} for n in d.not_testable],
        "invisible": [
            {
                "name": i.name,
                "expected_log_bayes_factor": _number(i.expected_log_bayes_factor),
                "parameter_shift": _parameters(i.shift),
                "breaks": i.breaks,
            }
            for i in d.invisible
        ],
        "advice": wording.advice(d),
        "logs": list(d.logs),
    }


def _finding(f: Finding) -> dict[str, Any]:
    closed = f.gap_closed
    return {
        "name": f.name,
        "probability": _number(f.probability),
        "log_bayes_factor": _number(f.log_bayes_factor),
        "equivalent": list(f.equivalent),
        "magnitude": {
            "name": f.magnitude.name,
            "value": _number(f.magnitude.value),
            "sd": _number(f.magnitude.sd),
            "unit": f.magnitude.unit,
        },
        "gap_closed": None
        if closed is None
        else {"fraction": _number(closed.fraction), "q05": _number(closed.q05), "q95": _number(closed.q95)},
        "rms_before_kW": _kilowatts(f.rms_before),
        "rms_after_kW": _kilowatts(f.rms_after),
        "parameter_shift": _parameters(f.shift),
        "span_s": [[_number(span.start), _number(span.end)] for span in f.span],
        "span_log": [span.log for span in f.span],
        "detail": f.detail,
    }


def _part(part: Part) -> dict[str, Any]:
    return {
        "cause": part.cause,
        "share": _number(part.share),
        "q05": _number(part.q05),
        "q95": _number(part.q95),
        "rms_kW": _kilowatts(part.rms),
        "reached_kW": _kilowatts(part.reached),
        "expected_kW": _kilowatts(part.expected),
    }


def _isolability(of: Isolability) -> dict[str, Any]:
    """Pairs with the sine of the angle between their traces: 0 cannot be told apart, 1 have nothing in common."""
    pairs = []
    for i, a in enumerate(of.names):
        for j in range(i + 1, len(of.names)):
            r = _number(of.correlation[i, j])
            distance = None if r is None else math.sqrt(max(1 - r * r, 0.0))
            pairs.append({"a": a, "b": of.names[j], "distance": distance, "correlation": r})
    visibility = [
        {"name": name, "expected_log_bayes_factor": _number(expected)}
        for name, expected in zip(of.names, of.expected_log_bayes_factor, strict=True)
    ]
    return {"pairs": pairs, "visibility": visibility}


def _parameters(p: Shift | None) -> dict[str, float | None] | None:
    return None if p is None else {"mass_kg": _number(p.mass), "A_N": _number(p.A), "C_N_s2_m2": _number(p.C)}


def _kilowatts(watts: float | None) -> float | None:
    return None if watts is None else _number(watts / 1e3)


def _number(x: float | None) -> float | None:
    return float(x) if x is not None and math.isfinite(x) else None

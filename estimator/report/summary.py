"""The JSON that `roadload estimate` and `roadload replay` print: keys that other programs rely on."""

import math
from dataclasses import fields
from typing import Any

import msgspec

from estimator.estimate import Coverage, Estimate, Marginal
from estimator.report.next_step import next_step
from estimator.streaming.replay import Run

NAMES = {"mass_kg": "m", "A_N": "A", "C_N_s2_m2": "C"}


def of_run(run: Run) -> dict[str, Any]:
    """One object for a whole run, with every update; times count from the first frame [s]."""
    final, pipeline = run.final, run.pipeline
    return {
        "status": final.status.value,
        "reason": final.reason,
        "advice": next_step(run),
        "parameters": parameters(final),
        "convergence": convergence(final),
        "coverage": coverage(final.coverage),
        "road": road(final),
        "rms_kW": None if final.rms is None else final.rms / 1e3,
        "samples": {"admitted": final.admitted, "rejected": dict(pipeline.estimator.rejected)},
        "frames": {
            "read": pipeline.traffic.frames,
            "used": pipeline.traffic.used,
            "reordered": pipeline.traffic.order.reordered,
            "steps_back": pipeline.traffic.order.steps_back,
            "errors": dict(run.skipped + pipeline.traffic.errors),
        },
        "effects": list(pipeline.effects),
        "magnitudes": {name: _marginal(marginal) for name, marginal in final.effects.items()},
        "updates": [_update(update, run.start) for update in run.updates],
    }


def _update(update: Estimate, start: float) -> dict[str, Any]:
    """One update; after a long stop it also says whether the load has changed since."""
    summary: dict[str, Any] = {"t_s": round(update.t - start, 3), "status": update.status.value}
    summary["parameters"] = parameters(update)
    if update.load is not None:
        change = update.load
        masses = {"mass_before_kg": change.before, "mass_after_kg": change.after}
        summary["load_changed"] = {"probability": change.probability, **masses}
    return summary


def parameters(estimate: Estimate) -> dict[str, dict[str, Any]]:
    """The marginals under their names with units, each with its status; without values where it is not estimated."""
    return {name: _parameter(estimate, which) for name, which in NAMES.items()}


def _parameter(estimate: Estimate, which: str) -> dict[str, Any]:
    status, reason = estimate.status_of(which)
    marginal = estimate.marginals[which]
    values = dict.fromkeys(field.name for field in fields(Marginal)) if marginal is None else _marginal(marginal)
    return {"status": status.value, "reason": reason, **values}


def road(estimate: Estimate) -> dict[str, Any] | None:
    """What the drive says of the road, where the model has one."""
    found = estimate.road
    if found is None:
        return None
    shown = {"slope_sd": found.slope_sd, "length_m": found.length, "shown_by": list(found.shown_by)}
    return shown | {"climbed_m": found.climbed}


def convergence(estimate: Estimate) -> dict[str, float | int | None] | None:
    """Diagnostics of the chains behind an estimate."""
    if estimate.convergence is None:
        return None
    values = msgspec.to_builtins(estimate.convergence)
    return {key: None if isinstance(v, float) and not math.isfinite(v) else v for key, v in values.items()}


def coverage(cells: Coverage) -> dict[str, float | int]:
    """Coverage with its fraction."""
    return {"fraction": cells.fraction, "occupied": cells.occupied, "available": cells.available}


def _marginal(marginal: Marginal) -> dict[str, float]:
    values: dict[str, float] = msgspec.to_builtins(marginal)
    return values

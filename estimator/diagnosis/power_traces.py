"""Compute measured and modelled power of the drives, for every figure, table and file of a diagnosis.

The rows are the means over 2 s of the budget, so the root mean square of a residual here is the stated one.
"""

from dataclasses import fields

import numpy as np

from estimator.components.budget import Residuals
from estimator.components.drive_state import DriveState
from estimator.components.plain_model import PlainModel
from estimator.diagnosis.decision import Decision
from estimator.diagnosis.lag import unaligned_residual
from estimator.diagnosis.result import Traces
from estimator.preparation.drive import Drive
from estimator.signals import Floats, Quantity

CONTEXT = (Quantity.GEAR, Quantity.HEADING, Quantity.TEMPERATURE)  # further axes along which residuals are listed


def traces_of(decision: Decision) -> Traces:
    """Traces of all drives, concatenated in order."""
    is_late = decision.lag is not None
    states = zip(decision.cases, decision.result.drives, decision.budget.residuals, strict=True)
    drives = [_traces(case.drive, state, residuals, is_late) for case, state, residuals in states]
    names = [field.name for field in fields(Traces)]
    return Traces(**{name: np.concatenate([getattr(drive, name) for drive in drives]) for name in names})


def context_of(decision: Decision) -> dict[Quantity, Floats]:
    """CONTEXT quantities (n,) at the rows of the traces, if they are known throughout all drives."""
    drives = decision.result.drives
    parts = {q: [drive.fit.strides.context.get(q, np.empty(0)) for drive in drives] for q in CONTEXT}
    later = [PlainModel(drive.fit).second for drive in drives]
    complete = [q for q, values in parts.items() if all(len(x) and np.isfinite(x).all() for x in values)]
    return {q: np.concatenate([x[at] for x, at in zip(parts[q], later, strict=True)]) for q in complete}


def _traces(drive: Drive, state: DriveState, residuals: Residuals, is_late: bool) -> Traces:
    """Traces of one drive; ``is_late``: a lag is named, so the plain model is fitted to power that is not shifted."""
    plain = PlainModel(state.fit, is_aligned=not is_late)
    driven = state.fit.strides
    measured = plain.paired(plain.power)
    base = unaligned_residual(state, residuals) if is_late else residuals.given
    later = plain.second
    travelled = np.cumsum(drive.strides.s1 - drive.strides.s0)[drive.strides.known]
    return Traces(
        t=plain.paired(driven.t) - drive.log_start,
        distance=travelled[later] - (driven.s1 - driven.s0)[later],
        speed=plain.paired(driven.speed),
        acceleration=plain.paired(driven.a),
        measured=measured,
        base=measured - base,
        extended=measured - residuals.held_out,
        road_known=measured - residuals.road_known,
        log=np.full(len(measured), float(drive.log)),
    )

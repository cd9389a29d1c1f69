"""Add an effect to the models of all drives: refine its shape, fit its times again, or extend the times of another."""

from dataclasses import replace

import numpy as np

from estimator.diagnosis import switching_times
from estimator.diagnosis.averaged_residual import averages_of
from estimator.diagnosis.candidates import refined
from estimator.diagnosis.held_out import held_out
from estimator.diagnosis.multi_drive import Drive, Joint
from estimator.diagnosis.thresholds import Thresholds
from estimator.model.design_matrix import Term, settled, union
from estimator.model.effects import Timing

MAX_RETIMINGS = 4  # fits of the times of one term
MAX_MEAN_SQUARE_RATIO = 1.05  # held-out, of one effect with longer times over that of two effects: one is preferred


def grown(drives: tuple[Drive, ...], joint: Joint, thresholds: Thresholds) -> tuple[Drive, ...]:
    """The drives with the effect in their models; an event is added only to drives with enough evidence of it."""
    found = []
    for drive, candidate in zip(drives, joint.each, strict=True):
        if candidate is None or (joint.is_event and candidate.log_bayes_factor < thresholds.min_log_bf_effect):
            found.append(drive)
        else:
            term = settled(refined(drive.model, averages_of(drive.model), candidate.term), drive.model.samples)
            found.append(_retimed(drive.having((*drive.model.terms, term)), term))
    return tuple(found)


def _retimed(drive: Drive, term: Term) -> Drive:
    """The drive with the times of a switching term fitted again, as long as that reduces the held-out residual."""
    for _ in range(MAX_RETIMINGS if term.effect.timing is Timing.SWITCHING and term.spans else 0):
        i = next((i for i, other in enumerate(drive.model.terms) if other is term), None)
        if i is None:
            break
        dwell = float(np.mean([end - start for start, end in term.spans or ()]))
        later = replace(term, spans=switching_times.again(drive.model, i, max(dwell, switching_times.BEAT)))
        if not later.spans or later.spans == term.spans:
            break
        better = drive.having((*drive.model.terms[:i], later, *drive.model.terms[i + 1 :]))
        if better is drive or _compared(better, drive) >= 1.0:
            break
        drive, term = better, later
    return drive


def merged(drives: tuple[Drive, ...], joint: Joint, bigger: tuple[Drive, ...]) -> tuple[Drive, ...]:
    """For each drive the ``bigger`` model, or one that gives its switching effect longer times and fits as well."""
    found = []
    for drive, big, candidate in zip(drives, bigger, joint.each, strict=True):
        best = big
        for i, term in enumerate(drive.model.terms):
            switches = term.effect.timing is Timing.SWITCHING and term.spans
            if big is drive or candidate is None or not candidate.term.spans or not switches:
                continue
            longer = replace(term, spans=union(term.spans or (), candidate.term.spans))
            other = _retimed(drive.having((*drive.model.terms[:i], longer, *drive.model.terms[i + 1 :])), longer)
            if other is not drive and _compared(other, best) < MAX_MEAN_SQUARE_RATIO:
                best = other
        found.append(best)
    return tuple(found)


def _compared(one: Drive, other: Drive) -> float:
    """Ratio of two models' held-out mean squares, on samples away from the switching times of both."""
    s = one.model.samples[np.isin(one.model.samples.t, other.model.samples.t)]
    a, b = (held_out(s, drive.model.terms, drive.model.road_load).mean_square for drive in (one, other))
    return a / b

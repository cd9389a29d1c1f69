"""A model grown by one effect: its shape refined, its times found again beside the others, or merged with theirs."""

from dataclasses import replace

import numpy as np

from estimator.diagnosis import switching_times
from estimator.diagnosis.averaged_residual import grains_of
from estimator.diagnosis.candidates import refined
from estimator.diagnosis.held_out import held_out
from estimator.diagnosis.multi_drive import Drive, Joint
from estimator.diagnosis.thresholds import Thresholds
from estimator.model.design_matrix import Term, settled, union
from estimator.model.effects import Timing

RETIMINGS = 4
AS_GOOD = 1.05  # times the mean square of the other


def grown(drives: tuple[Drive, ...], joint: Joint, thresholds: Thresholds) -> tuple[Drive, ...]:
    """The drives with an effect more; an event is added only where it is evident."""
    found = []
    for drive, candidate in zip(drives, joint.each, strict=True):
        if candidate is None or (joint.is_event and candidate.log_bayes_factor < thresholds.min_log_bf_effect):
            found.append(drive)
        else:
            term = settled(refined(drive.model, grains_of(drive.model), candidate.term), drive.model.samples)
            found.append(_retimed(drive.having((*drive.model.terms, term)), term))
    return tuple(found)


def _retimed(drive: Drive, term: Term) -> Drive:
    """The drive with the times of a switching term found again beside the others, as long as it gains by that."""
    for _ in range(RETIMINGS if term.effect.timing is Timing.SWITCHING and term.spans else 0):
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
    """Where longer times of a switching effect in the model explain as much as another beside it, the former."""
    found = []
    for drive, big, candidate in zip(drives, bigger, joint.each, strict=True):
        best = big
        for i, term in enumerate(drive.model.terms):
            switches = term.effect.timing is Timing.SWITCHING and term.spans
            if big is drive or candidate is None or not candidate.term.spans or not switches:
                continue
            longer = replace(term, spans=union(term.spans or (), candidate.term.spans))
            other = _retimed(drive.having((*drive.model.terms[:i], longer, *drive.model.terms[i + 1 :])), longer)
            if other is not drive and _compared(other, best) < AS_GOOD:
                best = other
        found.append(best)
    return tuple(found)


def _compared(one: Drive, other: Drive) -> float:
    """Mean square of what one model misses over that of another, away from the changes of either."""
    s = one.model.samples[np.isin(one.model.samples.t, other.model.samples.t)]
    a, b = (held_out(s, drive.model.terms, drive.model.road_load).mean_square for drive in (one, other))
    return a / b

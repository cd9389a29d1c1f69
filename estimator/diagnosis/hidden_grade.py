"""A grade that no signal shows: a force that varies with place."""

from collections.abc import Sequence

import numpy as np

from estimator.diagnosis.multi_drive import Drive, Joint
from estimator.diagnosis.processes import DRAG_OVER_TIME, FORCE_OVER_TIME, UNMEASURED_GRADE, Leftover
from estimator.diagnosis.thresholds import Thresholds
from estimator.model.design_matrix import MASS
from estimator.units import STANDARD_GRAVITY


def hidden_grade(
    ranking: Sequence[Joint], processes: Sequence[Leftover], drives: Sequence[Drive], thresholds: Thresholds
) -> Leftover | None:
    """The force over distance, where it has more evidence than every named effect: a grade that no signal shows.

    Every road has a grade, so the force need only reach a share of the evidence of the best process: on a road driven
    once, a force over time fits nearly as well. None where a drag over time fits as well as a force (gusts), where the
    grade would be flatter than ``min_grade_sd``, or where a signal of the climb rules a grade out, see `_is_settled`.
    """
    by_name = {left.name: left for left in processes}
    grade, drag = by_name[UNMEASURED_GRADE], by_name[DRAG_OVER_TIME]
    force = max(grade.log_bayes_factor, by_name[FORCE_OVER_TIME].log_bayes_factor)
    settled = any(_is_settled(joint, grade, drives, thresholds) for joint in ranking if joint.effect.is_gravity)
    named = max((joint.log_bayes_factor for joint in ranking), default=0.0)
    evident = grade.log_bayes_factor > max(thresholds.min_log_bf_process, named + thresholds.min_log_bf_lead)
    near = grade.log_bayes_factor > thresholds.min_grade_log_bf_share * processes[0].log_bayes_factor
    is_force = force > drag.log_bayes_factor + thresholds.min_log_bf_lead
    steep = grade_sd(grade, drives) > thresholds.min_grade_sd
    return grade if evident and near and is_force and steep and not settled else None


def _is_settled(gravity: Joint, force: Leftover, drives: Sequence[Drive], thresholds: Thresholds) -> bool:
    """Whether a signal of the climb explains the grade or rules it out.

    It explains the grade if the power follows the signal: the effect of the signal is named then. It rules the grade
    out if both hold: the sd of the signal is below the climb on such a grade, so its noise cannot hide that climb; and
    the mass lifted with the signal is below the vehicle's, so its changes are noise. A signal with more noise, or one
    that follows the road in part (a slow altimeter, one that stands still at times), decides nothing.
    """
    if gravity.log_bayes_factor > thresholds.min_log_bf_effect:
        return True
    for drive, candidate in zip(drives, gravity.each, strict=True):
        if candidate is None:
            continue
        mass = float(drive.model.road_load[MASS])
        climb = float(np.std(drive.model.samples.context[candidate.term.shape]))
        is_noise = candidate.value + thresholds.min_lift_deficit_sd * candidate.sd < mass
        if is_noise and climb < _climb(force, drive):
            return True
    return False


def _climb(force: Leftover, drive: Drive) -> float:
    """Standard deviation of the climb [m/s] on a grade that would be such a force."""
    return float(np.sqrt(force.variance)) / (max(float(drive.model.road_load[MASS]), 1.0) * STANDARD_GRAVITY)


def grade_sd(force: Leftover, drives: Sequence[Drive]) -> float:
    """Standard deviation of the grade [1] that would be such a force."""
    drive = max(drives, key=lambda drive: len(drive.model.samples))
    return _climb(force, drive) / float(np.sqrt(np.mean(drive.model.samples.v**2)))

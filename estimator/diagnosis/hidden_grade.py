"""A grade that no signal shows: a force that goes with the place."""

from collections.abc import Sequence

import numpy as np

from estimator.diagnosis.multi_drive import Drive, Joint
from estimator.diagnosis.processes import DRAG_OVER_TIME, FORCE_OVER_TIME, UNMEASURED_GRADE, Leftover
from estimator.diagnosis.thresholds import AHEAD, EVIDENT, NAMED
from estimator.model.design_matrix import MASS
from estimator.units import STANDARD_GRAVITY

NEAR = 0.5  # of the best evidence
FLATTEST = 0.002  # sd of a grade
SURE = 2.0  # sd by which what a signal shows lifts less than the vehicle


def hidden_grade(ranking: Sequence[Joint], processes: Sequence[Leftover], drives: Sequence[Drive]) -> Leftover | None:
    """A force that goes with the place and beats all that has a name: a grade that no signal shows, or None.

    Every road has one, so it need only come near the best of other processes: a force that goes with time is much the
    same on a road driven once. But it must be a force, and not a drag, as gusts are; and no road is so flat that a
    force worth less than FLATTEST would be it. A signal of the climb may have the last word: see `_settled`.
    """
    by_name = {left.name: left for left in processes}
    grade, drag = by_name[UNMEASURED_GRADE], by_name[DRAG_OVER_TIME]
    force = max(grade.log_bayes_factor, by_name[FORCE_OVER_TIME].log_bayes_factor)
    settled = any(_settled(joint, grade, drives) for joint in ranking if joint.effect.is_gravity)
    named = max((joint.log_bayes_factor for joint in ranking), default=0.0)
    evident = grade.log_bayes_factor > max(EVIDENT, named + AHEAD)
    near = grade.log_bayes_factor > NEAR * processes[0].log_bayes_factor
    is_force = force > drag.log_bayes_factor + AHEAD
    steep = grade_sd(grade, drives) > FLATTEST
    return grade if evident and near and is_force and steep and not settled else None


def _settled(gravity: Joint, force: Leftover, drives: Sequence[Drive]) -> bool:
    """Whether a signal of the climb has said already what there is to say of a grade.

    It has if the power follows it: then it is named itself. And it has if it would have shown such a grade and did
    not: it moves less than the grade would make it, so its noise hides none, and the engine lifts no mass along with
    what it does move, so that is noise. An altimeter that is too noisy, or that follows the road but only in part,
    as one does that is slow or stands still at times, leaves a grade unseen and speaks against none.
    """
    if gravity.log_bayes_factor > NAMED:
        return True
    for drive, candidate in zip(drives, gravity.each, strict=True):
        if candidate is None:
            continue
        mass = float(drive.model.road_load[MASS])
        climb = float(np.std(drive.model.samples.context[candidate.term.shape]))
        is_noise = candidate.value + SURE * candidate.sd < mass
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

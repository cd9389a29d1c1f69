"""A grade that no signal shows: a force that goes with the place."""

from collections.abc import Sequence

import numpy as np

from estimator.diagnosis.joint import Drive, Joint
from estimator.diagnosis.processes import UNMEASURED_GRADE, Leftover
from estimator.diagnosis.thresholds import AHEAD, EVIDENT, NAMED
from estimator.units import STANDARD_GRAVITY

NEAR = 0.8  # of the best evidence: at a steady speed time and place are the same
FLATTEST = 0.002  # sd of a grade


def hidden_grade(ranking: Sequence[Joint], processes: Sequence[Leftover], drives: Sequence[Drive]) -> Leftover | None:
    """A force that goes with the place and beats all that has a name: a grade that no signal shows, or None.

    Every road has one, so it need only come near the best of other processes; but no road is so flat that a force
    worth less than FLATTEST would be it. A signal of the climb that explains nothing speaks against it.
    """
    grade = next(left for left in processes if left.name == UNMEASURED_GRADE)
    refuted = any(joint.effect.is_gravity for joint in ranking)
    named = max((joint.log_bayes_factor for joint in ranking), default=0.0)
    evident = grade.log_bayes_factor > max(EVIDENT, named + AHEAD)
    best = processes[0].log_bayes_factor
    near = grade.log_bayes_factor > min(best - NAMED, NEAR * best)
    steep = grade_sd(grade, drives) > FLATTEST
    return grade if evident and near and steep and not refuted else None


def grade_sd(force: Leftover, drives: Sequence[Drive]) -> float:
    """Standard deviation of the grade [1] that would be such a force."""
    model = max((drive.model for drive in drives), key=lambda model: len(model.samples))
    speed = float(np.sqrt(np.mean(model.samples.v**2)))
    mass = max(float(model.road_load[2]), 1.0)
    return float(np.sqrt(force.variance)) / (mass * STANDARD_GRAVITY * speed)

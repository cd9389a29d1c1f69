"""Estimates of other control units on the bus, of mass and grade: shown beside ours, and passed on to nothing.

Some cars send a mass and a grade of their own. Their readings are taken out before the rows are made, so an estimate
has the same bits with and without them.
"""

from collections import Counter
from collections.abc import Mapping

import numpy as np

from estimator.answers import reference as answers
from estimator.estimation.road_fit import RoadFit
from estimator.signals import REFERENCES, Role, Series

SPAN = 3600.0  # s of readings that are kept, one a second: as long as the window of the estimate
MAX_STEP = 2.0  # s between two of them that are joined by a straight line
NOTHING = Series(np.empty(0), np.empty(0))
PERCENT = 100.0

MeanAndSd = tuple[float, float]


class References:
    """Keeps the readings of the roles in REFERENCES that are bound, by MESSAGE.signal in ``names``."""

    def __init__(self, names: Mapping[Role, str]) -> None:
        self._names = {role: path for role, path in names.items() if role in REFERENCES}
        self._counts: Counter[Role] = Counter()
        self._newest: dict[Role, tuple[float, float]] = {}  # time [s] and value
        self._kept: dict[Role, Series] = {}

    def take(self, readings: Mapping[Role, list[Series]]) -> dict[Role, list[Series]]:
        """Keep the readings of references; returns those of all other roles."""
        for role in self._names.keys() & readings.keys():
            for part in readings[role]:
                self._keep(role, part)
        return {role: parts for role, parts in readings.items() if role not in REFERENCES}

    def answer(self, now: float | None, mass: MeanAndSd | None, fit: RoadFit | None) -> answers.References:
        """The references as of message time ``now`` [s].

        Parameters
        ----------
        now
            None: the time of the newest reading of each.
        mass
            Mean and standard deviation of our mass [kg]; None where it is not known.
        fit
            Has our road; None where there is none.
        """
        weight, grade = self._newest.get(Role.MASS_REFERENCE), self._kept.get(Role.GRADE_REFERENCE)
        by_mass = None if mass is None or weight is None else (weight[1] - mass[0], mass[1])
        by_grade = None if fit is None or grade is None else _along_the_road(grade, fit)
        return answers.References(
            mass_kg=self._answer(Role.MASS_REFERENCE, now, 1.0, by_mass),
            grade_percent=self._answer(Role.GRADE_REFERENCE, now, PERCENT, by_grade),
        )

    def _answer(
        self, role: Role, now: float | None, factor: float, difference: MeanAndSd | None
    ) -> answers.Reference | None:
        """One of them in the unit of the answer, which is the SI unit over ``factor``; None where it never came."""
        if role not in self._newest:
            return None
        (t, value), kept = self._newest[role], factor * self._kept[role].value
        mean, sd = (None, None) if difference is None else (factor * difference[0], factor * difference[1])
        return answers.Reference(
            signal=self._names[role],
            readings=self._counts[role],
            age_s=0.0 if now is None else round(max(now - t, 0.0), 3),
            newest=factor * value,
            lowest=float(kept.min()),
            highest=float(kept.max()),
            difference=mean,
            difference_sd=sd,
        )

    def _keep(self, role: Role, part: Series) -> None:
        known = np.isfinite(part.value)
        t, value = part.t[known], part.value[known]
        if not len(t):
            return
        self._counts[role] += len(t)
        self._newest[role] = float(t[-1]), float(value[-1])
        before = self._kept.get(role, NOTHING)
        if len(before.t) and t[0] < before.t[-1]:  # another recording
            before = NOTHING
        seconds = np.floor(np.concatenate([before.t[-1:], t]))
        first = np.diff(seconds, prepend=-np.inf)[-len(t) :] >= 1
        joined = Series(np.concatenate([before.t, t[first]]), np.concatenate([before.value, value[first]]))
        is_new = joined.t > t[-1] - SPAN
        self._kept[role] = Series(joined.t[is_new], joined.value[is_new])


def _along_the_road(kept: Series, fit: RoadFit) -> MeanAndSd | None:
    """Grades read minus those of the fit, at its strides between two readings; None where there are none."""
    t = fit.strides.t
    if len(kept.t) < 2:
        return None
    after = np.clip(np.searchsorted(kept.t, t), 1, len(kept.t) - 1)
    near = (kept.t[after] - kept.t[after - 1] <= MAX_STEP) & (t >= kept.t[0]) & (t <= kept.t[-1])
    if not near.any():
        return None
    ours = fit.slope / np.sqrt(1 - fit.slope**2)  # tangent of a sine
    difference = (np.interp(t, kept.t, kept.value) - ours)[near]
    return float(difference.mean()), float(difference.std())

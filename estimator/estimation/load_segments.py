"""Load segments: a new one after a long stop, the belief carried over, and the probability that the mass changed.

While a vehicle moves its mass is constant. After a stop that is long enough to load or unload, the mass is unknown.
The drag coefficient C and the rolling coefficient A / m (rolling resistance is proportional to the load) are carried
over, with a variance that grows with time.

After a stop of less than SHORT_STOP the driving before stays in use instead: its loads have masses of their own, and
A / m, C, road and noise are those of all of it.
"""

from dataclasses import dataclass
from math import exp, log, sqrt
from typing import Any

import numpy as np

from estimator.checkpoint.validation import State, array, optional, read
from estimator.errors import StateError
from estimator.estimates import LoadChange
from estimator.estimation.belief import PARAMETERS, Belief
from estimator.model.road_load import NEW_LOAD_SD
from estimator.settings import Load
from estimator.signals import Floats
from estimator.units import HOUR

SHORT_STOP = 300.0  # s of `load.stop_s`: between shorter stops is too little driving to find road and noise from
KEPT_LOADS = 15  # loads before the present one whose driving stays in use after short stops
MAX_LOG_ODDS = 700.0  # exp overflows beyond; the probability is 0 or 1 in floating point


@dataclass(frozen=True)
class Segment:
    """Posterior mean (3,) and covariance (3, 3) of A, C, m under one load, and its last time ``t`` [s]."""

    mean: Floats
    covariance: Floats
    t: float

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads."""
        return {"mean": self.mean, "covariance": self.covariance, "t": self.t}

    @classmethod
    def restore(cls, state: State) -> "Segment":
        """A segment from its state.

        Raises
        ------
        StateError
            It is not that of a segment.
        """
        mean, covariance = array(state, "mean", (PARAMETERS,)), array(state, "covariance", (PARAMETERS, PARAMETERS))
        variance = np.diag(covariance)
        if mean[2] <= 0 or np.any(variance <= 0) or np.any(covariance**2 > 1.001 * np.outer(variance, variance)):
            raise StateError("segment: no mass, or no covariance")
        return cls(mean, covariance, read(state, "t", float))

    def carry_over(self, t: float, load: Load) -> Belief:
        """Belief about the next load at time ``t`` [s]: C and A / m as before, with the variance of the drift."""
        A, C, m = self.mean
        doubt = load.drift_per_hour**2 * max(t - self.t, 0.0) / HOUR + load.change_sd**2
        ratio = np.array([1 / m, -A / m**2]) @ self.covariance[np.ix_([0, 2], [0, 2])] @ np.array([1 / m, -A / m**2])
        sd_ratio, sd_C = sqrt(ratio + doubt * (A / m) ** 2), sqrt(self.covariance[1, 1] + doubt * C**2)
        # A - (A / m) m = 0 with the sd of A / m times the old mass; C with its own sd.
        rolling, drag = np.zeros(PARAMETERS), np.zeros(PARAMETERS)
        rolling[0], rolling[2] = 1.0, -A / m
        drag[1] = 1.0
        rolling, drag = rolling / (sd_ratio * m), drag / sd_C
        precision = np.outer(rolling, rolling) + np.outer(drag, drag)
        return Belief(precision, drag * (C / sd_C))


class Loads:
    """The segments of the present load and of the one before it."""

    def __init__(self) -> None:
        self._shown: Segment | None = None
        self._before: Segment | None = None
        self._carried: Segment | None = None  # the newest whose driving is used no longer

    def start_segment(self, kept: bool = False) -> None:
        """Begin a new load: the present segment becomes the one before; its driving is ``kept`` in use, or not."""
        if self._shown is not None:
            self._before = self._shown
        self._shown = None
        if not kept:
            self._carried = self._before

    def forget_vehicle(self) -> None:
        """Discard the segments before the present one: they may be another vehicle's."""
        self._before = self._carried = None

    def carried_over(self, t: float, load: Load) -> Belief:
        """Belief at time ``t`` [s] from driving that is used no longer; empty where there was none."""
        if self._carried is None:
            return Belief.none()
        return self._carried.carry_over(t, load)

    def show(self, segment: Segment) -> LoadChange | None:
        """Store the segment of the present load; returns whether the mass differs from the load before."""
        self._shown = segment
        return None if self._before is None else load_change(self._before, segment)

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads."""
        return {
            "shown": None if self._shown is None else self._shown.state(),
            "before": None if self._before is None else self._before.state(),
            "carried": None if self._carried is None else self._carried.state(),
        }

    def restore(self, state: State) -> None:
        """Take the state of another one.

        Raises
        ------
        StateError
            The state is not that of loads.
        """
        self._shown = optional(state, "shown", Segment.restore)
        self._before = optional(state, "before", Segment.restore)
        self._carried = optional(state, "carried", Segment.restore)


def load_change(before: Segment, after: Segment) -> LoadChange:
    """Probability that the mass [kg] of two segments differs.

    Two hypotheses of equal prior probability: the same mass, so the means differ by their sd; or another mass, Gaussian
    about the old one with the relative sd NEW_LOAD_SD.
    """
    m0, m1 = float(before.mean[2]), float(after.mean[2])
    noise = float(before.covariance[2, 2] + after.covariance[2, 2])
    other = noise + (NEW_LOAD_SD * m0) ** 2
    d = (m1 - m0) ** 2
    log_odds = 0.5 * (log(noise / other) + d / noise - d / other)
    probability = 1 / (1 + exp(-min(max(log_odds, -MAX_LOG_ODDS), MAX_LOG_ODDS)))
    return LoadChange(probability, m0, m1)

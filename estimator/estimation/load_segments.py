"""Load segments: the driving between two long stops, with the belief carried over and the probability of a new mass.

The mass of a moving vehicle is constant. After a stop that is long enough to load or unload, the mass is unknown.
The drag coefficient C and the rolling coefficient A / m (rolling resistance is proportional to the load) are carried
over, with a variance that grows with time.

With a `load.stop_s` below SHORT_STOP the earlier driving stays in the window instead: each load has its own mass, and
A / m, C, road and noise are common to all loads.
"""

from dataclasses import dataclass
from math import log, sqrt, tanh
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

SHORT_STOP = 300.0  # s of `load.stop_s`: the driving between shorter stops is too short to determine road and noise
KEPT_LOADS = 15  # loads before the present one whose driving stays in use after short stops


@dataclass(frozen=True)
class Segment:
    """Posterior mean (3,) and covariance (3, 3) of A, C, m under one load, and its last time ``t`` [s]."""

    mean: Floats
    covariance: Floats
    t: float

    def state(self) -> dict[str, Any]:
        """Return the state that `restore` reads."""
        return {"mean": self.mean, "covariance": self.covariance, "t": self.t}

    @classmethod
    def restore(cls, state: State) -> "Segment":
        """Return the segment that a state describes.

        Raises
        ------
        StateError
            The state does not belong to a segment.
        """
        mean, covariance = array(state, "mean", (PARAMETERS,)), array(state, "covariance", (PARAMETERS, PARAMETERS))
        variance = np.diag(covariance)
        if mean[2] <= 0 or np.any(variance <= 0) or np.any(covariance**2 > 1.001 * np.outer(variance, variance)):
            raise StateError("segment: no mass, or no covariance")
        return cls(mean, covariance, read(state, "t", float))

    def carry_over(self, t: float, load: Load) -> Belief:
        """Return the belief for the next load at time ``t`` [s]: C and A / m of this one, with variance of drift."""
        A, C, m = self.mean
        doubt = load.drift_per_hour**2 * max(t - self.t, 0.0) / HOUR + load.change_sd**2
        ratio = np.array([1 / m, -A / m**2]) @ self.covariance[np.ix_([0, 2], [0, 2])] @ np.array([1 / m, -A / m**2])
        sd_ratio, sd_C = sqrt(ratio + doubt * (A / m) ** 2), sqrt(self.covariance[1, 1] + doubt * C**2)
        # A - (A / m) m = 0 with the sd of A / m times the mass of this segment; C with the sd sd_C.
        rolling, drag = np.zeros(PARAMETERS), np.zeros(PARAMETERS)
        rolling[0], rolling[2] = 1.0, -A / m
        drag[1] = 1.0
        rolling, drag = rolling / (sd_ratio * m), drag / sd_C
        precision = np.outer(rolling, rolling) + np.outer(drag, drag)
        return Belief(precision, drag * (C / sd_C))


class Loads:
    """Segments of the present load and of the load before it."""

    def __init__(self) -> None:
        self._shown: Segment | None = None
        self._before: Segment | None = None
        self._carried: Segment | None = None  # newest segment whose driving is no longer in the window

    def start_segment(self, kept: bool = False) -> None:
        """Begin a new load: the present segment becomes the previous one; ``kept`` if its driving stays in use."""
        if self._shown is not None:
            self._before = self._shown
        self._shown = None
        if not kept:
            self._carried = self._before

    def forget_vehicle(self) -> None:
        """Discard the segments before the present one: they may belong to another vehicle."""
        self._before = self._carried = None

    def carried_over(self, t: float, load: Load) -> Belief:
        """Return the belief at time ``t`` [s] from driving no longer in use; without information if there was none."""
        if self._carried is None:
            return Belief.none()
        return self._carried.carry_over(t, load)

    def show(self, segment: Segment) -> LoadChange | None:
        """Store the segment of the present load; return its change of mass from the load before, None without one."""
        self._shown = segment
        return None if self._before is None else load_change(self._before, segment)

    def state(self) -> dict[str, Any]:
        """Return the state that `restore` reads."""
        return {
            "shown": None if self._shown is None else self._shown.state(),
            "before": None if self._before is None else self._before.state(),
            "carried": None if self._carried is None else self._carried.state(),
        }

    def restore(self, state: State) -> None:
        """Load the state of another instance.

        Raises
        ------
        StateError
            The state does not belong to loads.
        """
        self._shown = optional(state, "shown", Segment.restore)
        self._before = optional(state, "before", Segment.restore)
        self._carried = optional(state, "carried", Segment.restore)


def load_change(before: Segment, after: Segment) -> LoadChange:
    """Return the probability that the masses [kg] of two segments differ.

    Two hypotheses have equal prior probability: one mass, so that the means differ by their sd alone; or a new mass,
    Gaussian about the old one with the relative sd NEW_LOAD_SD.
    """
    m0, m1 = float(before.mean[2]), float(after.mean[2])
    noise = float(before.covariance[2, 2] + after.covariance[2, 2])
    other = noise + (NEW_LOAD_SD * m0) ** 2
    d = (m1 - m0) ** 2
    log_odds = 0.5 * (log(noise / other) + d / noise - d / other)
    probability = 0.5 * (1 + tanh(0.5 * log_odds))
    return LoadChange(probability, m0, m1)

"""Loads change at standstill: when to start afresh, what to keep, and whether the mass has changed.

While a vehicle moves its mass is one number. After a stop that is long enough to load or unload, the mass starts
afresh; what the vehicle has shown of itself stays, with a doubt that grows with time: the drag coefficient C, and the
rolling coefficient A / m, for rolling resistance goes with the load.
"""

from dataclasses import dataclass
from math import exp, log, sqrt
from typing import Any

import numpy as np

from estimator.checkpoint.validation import State, array, optional, read
from estimator.errors import StateError
from estimator.estimate import LoadChange
from estimator.estimation.moments import PARAMETERS, ROAD_LOAD, Belief
from estimator.settings import Load
from estimator.signals import Floats

HOUR = 3600.0  # s
OTHER_LOAD = 0.5  # sd of a new load's mass, as a share of the old: empty to full doubles a truck's weight
LARGEST_ODDS = 700.0  # log odds beyond which exp overflows and nobody cares


@dataclass(frozen=True)
class Segment:
    """What one load has shown: posterior mean and covariance of A, C, m (3,), (3, 3), and when it ended [s]."""

    mean: Floats
    covariance: Floats
    t: float

    def state(self) -> dict[str, Any]:
        """What `restore` makes the same segment from."""
        return {"mean": self.mean, "covariance": self.covariance, "t": self.t}

    @classmethod
    def restore(cls, state: State) -> "Segment":
        """A segment from its state.

        Raises
        ------
        StateError
            It is not that of a segment.
        """
        mean, covariance = array(state, "mean", (ROAD_LOAD,)), array(state, "covariance", (ROAD_LOAD, ROAD_LOAD))
        variance = np.diag(covariance)
        if mean[2] <= 0 or np.any(variance <= 0) or np.any(covariance**2 > 1.001 * np.outer(variance, variance)):
            raise StateError("segment: no mass, or no covariance")
        return cls(mean, covariance, read(state, "t", float))

    def carry_over(self, t: float, load: Load) -> Belief:
        """Belief about the next load at time ``t`` [s]: C and A / m as they were, give or take the drift."""
        A, C, m = self.mean
        doubt = load.drift_per_hour**2 * max(t - self.t, 0.0) / HOUR + load.change_sd**2
        ratio = np.array([1 / m, -A / m**2]) @ self.covariance[np.ix_([0, 2], [0, 2])] @ np.array([1 / m, -A / m**2])
        sd_ratio, sd_C = sqrt(ratio + doubt * (A / m) ** 2), sqrt(self.covariance[1, 1] + doubt * C**2)
        # A - (A / m) m = 0 within the doubt at the old mass; C = C within its own.
        rolling, drag = np.zeros(PARAMETERS), np.zeros(PARAMETERS)
        rolling[0], rolling[2] = 1.0, -A / m
        drag[1] = 1.0
        rolling, drag = rolling / (sd_ratio * m), drag / sd_C
        precision = np.outer(rolling, rolling) + np.outer(drag, drag)
        return Belief(precision, drag * (C / sd_C))


class Loads:
    """What the present load and the one before it have shown."""

    def __init__(self) -> None:
        self._shown: Segment | None = None
        self._before: Segment | None = None

    def start_segment(self) -> None:
        """Another load, perhaps: what this one has shown becomes what was shown before."""
        if self._shown is not None:
            self._before = self._shown
        self._shown = None

    def forget_vehicle(self) -> None:
        """It may be another vehicle."""
        self._before = None

    def carried_over(self, t: float, load: Load) -> Belief:
        """Belief at time ``t`` [s] from the load before; empty where there was none."""
        if self._before is None:
            return Belief(np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS))
        return self._before.carry_over(t, load)

    def show(self, segment: Segment) -> LoadChange | None:
        """Remember what the present load has shown; says whether it differs from the one before."""
        self._shown = segment
        return None if self._before is None else load_change(self._before, segment)

    def state(self) -> dict[str, Any]:
        """What `restore` goes on from."""
        return {
            "shown": None if self._shown is None else self._shown.state(),
            "before": None if self._before is None else self._before.state(),
        }

    def restore(self, state: State) -> None:
        """Know what another knew.

        Raises
        ------
        StateError
            The state is not that of loads.
        """
        self._shown = optional(state, "shown", Segment.restore)
        self._before = optional(state, "before", Segment.restore)


def load_change(before: Segment, after: Segment) -> LoadChange:
    """Probability that the mass [kg] is another one, from what two segments have shown.

    Two hypotheses, equally likely beforehand: the same mass, so that the means differ by their noise; or another,
    which lies within OTHER_LOAD of the old one.
    """
    m0, m1 = float(before.mean[2]), float(after.mean[2])
    noise = float(before.covariance[2, 2] + after.covariance[2, 2])
    other = noise + (OTHER_LOAD * m0) ** 2
    d = (m1 - m0) ** 2
    log_odds = 0.5 * (log(noise / other) + d / noise - d / other)
    probability = 1 / (1 + exp(-min(max(log_odds, -LARGEST_ODDS), LARGEST_ODDS)))
    return LoadChange(probability, m0, m1)

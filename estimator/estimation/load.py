"""Loads change at standstill: when to start afresh, what to keep, and whether the mass has changed.

While a vehicle moves its mass is one number. After a stop that is long enough to load or unload, the mass starts
afresh; what the vehicle has shown of itself stays, with a doubt that grows with time: the drag coefficient C, and the
rolling coefficient A / m, for rolling resistance goes with the load.
"""

from dataclasses import dataclass
from math import exp, log, sqrt
from typing import Any

import numpy as np

from estimator.errors import StateError
from estimator.estimate import LoadChange
from estimator.estimation.moments import PARAMETERS, ROAD_LOAD, Belief
from estimator.samples import STEP
from estimator.settings import Load
from estimator.signals import Floats
from estimator.state import Count, State, array, read

HOUR = 3600.0  # s
OTHER_LOAD = 0.5  # sd of a new load's mass, as a share of the old: empty to full doubles a truck's weight
LARGEST_ODDS = 700.0  # log odds beyond which exp overflows and nobody cares


class Standstill:
    """Tells from speeds on the grid when a vehicle drives off after a long stop."""

    def __init__(self, load: Load, standing_speed: float) -> None:
        self._long = round(load.stop_s / STEP)
        self._speed = standing_speed
        self._standing = 0  # rows in a row

    def drives_off(self, speed: Floats) -> bool:
        """Whether these rows (n,) [m/s], the next ones, hold a departure after a stop of the configured length.

        A row without a speed ends no stop: ignition is off in most of them.
        """
        moving = np.flatnonzero(speed >= self._speed)
        if not len(moving):
            self._standing += len(speed)
            return False
        rests = np.diff(np.concatenate([[-1 - self._standing], moving])) - 1
        self._standing = len(speed) - 1 - int(moving[-1])
        return bool(rests.max() >= self._long)

    def pause(self, rows: int) -> None:
        """Count a silence of the bus as standing: nobody saw what was loaded."""
        self._standing += rows

    def state(self) -> dict[str, Any]:
        """What `restore` goes on from."""
        return {"standing": self._standing}

    def restore(self, state: State) -> None:
        """Have stood for as long as another.

        Raises
        ------
        StateError
            The state is not that of a standstill.
        """
        self._standing = read(state, "standing", Count)


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

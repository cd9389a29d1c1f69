"""Standstills long enough to load or unload."""

from typing import Any

import numpy as np

from estimator.checkpoint.validation import Count, State, read
from estimator.samples import STEP
from estimator.settings import Load
from estimator.signals import Floats


class Standstill:
    """Finds departures after long stops in speeds on the grid."""

    def __init__(self, load: Load, standing_speed: float) -> None:
        self._long = round(load.stop_s / STEP)
        self._speed = standing_speed
        self.rows = 0  # that the present stop has lasted; 0 in motion

    def departures(self, speed: Floats) -> list[int]:
        """Indices of the departures in the next rows, with speeds (n,) [m/s], after stops of at least `Load.stop_s`.

        A row without a speed ends no stop: in most of them the ignition is off.
        """
        moving = np.flatnonzero(speed >= self._speed)
        if not len(moving):
            self.rows += len(speed)
            return []
        rests = np.diff(np.concatenate([[-1 - self.rows], moving])) - 1
        self.rows = len(speed) - 1 - int(moving[-1])
        found: list[int] = moving[rests >= self._long].tolist()
        return found

    def pause(self, rows: int) -> None:
        """Count a silence of the bus as standing: the load may change in it."""
        self.rows += rows

    def state(self) -> dict[str, Any]:
        """State for `restore`."""
        return {"standing": self.rows}

    def restore(self, state: State) -> None:
        """Take the state of another instance.

        Raises
        ------
        StateError
            The state is not that of a standstill.
        """
        self.rows = read(state, "standing", Count)

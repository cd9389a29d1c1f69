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
        self._standing = 0  # rows in a row

    def departure(self, speed: Floats) -> int | None:
        """Index of the last departure in the next rows, with speeds (n,) [m/s], after a stop of at least `Load.stop_s`.

        None if there is no such departure. A row without a speed ends no stop: in most of them the ignition is off.
        """
        moving = np.flatnonzero(speed >= self._speed)
        if not len(moving):
            self._standing += len(speed)
            return None
        rests = np.diff(np.concatenate([[-1 - self._standing], moving])) - 1
        self._standing = len(speed) - 1 - int(moving[-1])
        long = np.flatnonzero(rests >= self._long)
        return int(moving[long[-1]]) if len(long) else None

    def pause(self, rows: int) -> None:
        """Count a silence of the bus as standing: the load may change in it."""
        self._standing += rows

    def state(self) -> dict[str, Any]:
        """State for `restore`."""
        return {"standing": self._standing}

    def restore(self, state: State) -> None:
        """Take the state of another instance.

        Raises
        ------
        StateError
            The state is not that of a standstill.
        """
        self._standing = read(state, "standing", Count)

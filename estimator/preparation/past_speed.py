"""Speed of the past minutes, which warms tyres and oil: the speed low-passed over the times of PAST_SPEEDS.

The speed counts as 0 while the bus is silent, and for all times before the first message.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.checkpoint.validation import State, array, read
from estimator.preparation.recursion import low_passed
from estimator.roles import PAST_SPEEDS
from estimator.samples import STEP
from estimator.signals import Floats, Quantity


def last_known(values: Floats, initial: float) -> Floats:
    """Hold the last known of the values (n,) where one is unknown; ``initial`` is the value before the first."""
    index = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(1, len(values) + 1), 0))
    return np.concatenate([[initial], values])[index]


class PastSpeed:
    """Low-passes the speed on the time grid; the result does not depend on how the rows are cut into batches."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Set past speeds to 0: the vehicle may be another one, or have stood for long."""
        self._values = np.zeros(len(PAST_SPEEDS))  # [m/s] at the row before the next one
        self._speed = 0.0  # [m/s] last known
        self._next: int | None = None  # row of the grid

    def follow(self, index: NDArray[np.int64], speed: Floats) -> dict[Quantity, Floats]:
        """Low-passed speeds (n,) [m/s] at consecutive rows of the grid (n,); the last known speed is held."""
        gap = 0 if self._next is None else int(index[0]) - self._next
        if gap < 0:  # time was set back
            self.forget()
        if gap > 0:
            self._values = self._values * np.exp(-gap * STEP / np.array([*PAST_SPEEDS.values()]))
            self._speed = 0.0
        held = last_known(speed, self._speed)
        past = {
            quantity: low_passed(held, previous, STEP, time)
            for (quantity, time), previous in zip(PAST_SPEEDS.items(), self._values.tolist(), strict=True)
        }
        self._values = np.array([values[-1] for values in past.values()])
        self._speed, self._next = float(held[-1]), int(index[-1]) + 1
        return past

    def state(self) -> dict[str, Any]:
        """State for `restore`."""
        return {"values": self._values, "speed": self._speed, "next": self._next}

    def restore(self, state: State) -> None:
        """Take the state of another instance.

        Raises
        ------
        StateError
            The state is not that of past speeds.
        """
        values = array(state, "values", (len(PAST_SPEEDS),))
        self._speed, self._next = read(state, "speed", float), read(state, "next", int | None)
        self._values = values

"""Engine friction torque at a finer resolution than that of its signal.

SPN 514 comes in steps of 1 % of the reference torque, often 25 N.m. An error of half a step, constant at a constant
engine speed, is several per cent of the rolling resistance. Friction is a smooth function of engine speed, and lies
within half a step of each reading. A curve is fitted to all readings so far and clipped to the interval of each. Its
error is at most that of the interval, and mostly much smaller than that of the reading.

All engine speeds have the same weight, for any duration: an hour of cruising repeats one rounded reading, which would
bias the curve at that speed. A reading belongs to the engine speed at which it was sent. The correction of the curve
by clipping is held until the next reading, a quarter of a second later.

Bins, weights, ridge and memory were chosen by hand, on three simulated drives of 40 min (hills, highway, city). Half
and twice of each move the mass by at most 0.17 sd, A and C by at most 0.13 sd.
"""

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.checkpoint.validation import State, array
from estimator.errors import StateError
from estimator.signals import Floats

DEGREE = 3  # of the curve in engine speed
SPEED_SCALE = 150.0  # rad/s, to keep powers of the speed near one
BIN_WIDTH = 3.0  # rad/s, engine speeds that count as one
BINS = 400  # of BIN_WIDTH: up to 1200 rad/s, 11,460 rpm
MAX_LEVELS = 256  # different readings: a sender with more has a finer resolution than 1 %, and needs no curve
MAX_BIN_WEIGHT = 50.0  # readings: more in the same bin add no weight
RIDGE = 1e-3  # weight, in readings, of a prior with zero slope: makes a drive at one speed solvable
MEMORY_READINGS = 36_000.0  # readings after which old ones fade, as oil warms: 12 min at 50 Hz


class FrictionCurve:
    """Running least-squares polynomial of friction over engine speed."""

    def __init__(self) -> None:
        self._sums = np.zeros((3, BINS))  # of readings in each bin: how many, their engine speeds, their values
        self._levels = np.empty(0)

    def refine(self, engine_speed: Floats, reading: Floats, speed_then: Floats, bounds: NDArray[np.intp]) -> Floats:
        """Friction (n,) as a share of reference torque at ``engine_speed`` (n,) [rad/s].

        ``reading`` (n,) is the last one at each moment, sent at the engine speed ``speed_then`` (n,) [rad/s]. The
        result is NaN where one of the three is, and the reading itself while the step of the readings is unknown. The
        curve is refitted for each block between ``bounds`` (k + 1,), to all readings up to its end.
        """
        is_complete = np.isfinite(engine_speed) & np.isfinite(reading) & np.isfinite(speed_then)
        speed, value = speed_then[is_complete], reading[is_complete]
        block = np.searchsorted(bounds[1:], np.flatnonzero(is_complete), side="right")
        half_step, curve = self._learn(speed, value, np.searchsorted(block, np.arange(len(bounds))))
        then = _curve_values(curve[block], speed)
        within = np.clip(then, value - half_step[block], value + half_step[block])
        refined = np.full(len(reading), np.nan)
        shown = np.isfinite(half_step)[block]
        refined[is_complete] = np.where(
            shown, _curve_values(curve[block], engine_speed[is_complete]) + (within - then), value
        )
        return refined

    def _learn(self, speed: Floats, value: Floats, bounds: NDArray[np.intp]) -> tuple[Floats, Floats]:
        """Half a step (k,) and coefficients of the curve (k, DEGREE + 1) after each block of known readings.

        Both are NaN while the step of the readings is unknown.
        """
        blocks = len(bounds) - 1
        cell = np.clip(speed / BIN_WIDTH, 0, BINS - 1).astype(np.int64)
        cell += BINS * np.repeat(np.arange(blocks), np.diff(bounds))
        weights = (np.ones(len(cell)), speed, value)
        new = np.stack([np.bincount(cell, weight, BINS * blocks).reshape(blocks, BINS) for weight in weights], axis=1)
        rounded = np.round(value, 6)
        is_new = bool(np.setdiff1d(rounded, self._levels).size)
        half_step, curve = np.full(blocks, np.nan), np.full((blocks, DEGREE + 1), np.nan)
        for i, (low, high) in enumerate(pairwise(bounds.tolist())):
            if low == high and i:
                half_step[i], curve[i] = half_step[i - 1], curve[i - 1]
                continue
            if is_new and len(self._levels) <= MAX_LEVELS:
                self._levels = np.union1d(self._levels, rounded[low:high])
            self._sums = np.exp((low - high) / MEMORY_READINGS) * self._sums + new[i]
            if 2 <= len(self._levels) <= MAX_LEVELS:
                half_step[i], curve[i] = float(np.diff(self._levels).min()) / 2, self._curve()
        return half_step, curve

    @property
    def constant(self) -> tuple[float, float, float] | None:
        """The only reading so far, and the engine speeds between which it was sent [rad/s], the higher twice the lower.

        None where readings differ, or engine speeds do not. Only speeds with as many readings as count are used.
        """
        count, speeds, _ = self._sums[:, self._sums[0] >= MAX_BIN_WEIGHT]
        if len(self._levels) != 1 or not len(count):
            return None
        low, high = (float(x) for x in ((speeds / count).min(), (speeds / count).max()))
        return (float(self._levels[0]), low, high) if high >= 2 * low else None

    def state(self) -> dict[str, Any]:
        """State for `restore`."""
        return {"sums": self._sums, "levels": self._levels}

    def restore(self, state: State) -> None:
        """Take the state of another curve.

        Raises
        ------
        StateError
            The state is not that of a curve.
        """
        sums, levels = array(state, "sums", (3, BINS)), array(state, "levels", (-1,))
        if np.any(sums[0] < 0) or np.any(np.diff(levels) <= 0):
            raise StateError("friction: counts below zero, or levels out of order")
        self._sums, self._levels = sums, levels

    def _curve(self) -> Floats:
        """Coefficients (DEGREE + 1,) of the curve in ascending powers of engine speed / SPEED_SCALE."""
        count, speeds, values = self._sums[:, self._sums[0] > 0]
        powers = np.vander(speeds / count / SPEED_SCALE, DEGREE + 1, increasing=True)
        weighted = powers.T * np.minimum(count, MAX_BIN_WEIGHT)
        ridge = np.diag([0.0] + [RIDGE] * DEGREE)
        coefficients: Floats = np.linalg.solve(weighted @ powers + ridge, weighted @ (values / count))
        return coefficients


def _curve_values(curve: Floats, engine_speed: Floats) -> Floats:
    """Values (n,) of curves (n, DEGREE + 1) by Horner's rule; each value is computed from one row of coefficients."""
    x = engine_speed / SPEED_SCALE
    value = curve[:, DEGREE]
    for power in range(DEGREE - 1, -1, -1):
        value = value * x + curve[:, power]
    return value

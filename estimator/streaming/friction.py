"""Engine friction torque between the steps in which it is sent.

SPN 514 comes in steps of 1 % of the reference torque, often 25 N.m. An error of half a step, constant at a constant
engine speed, is several per cent of the rolling resistance. Friction is a smooth function of engine speed, and lies
within half a step of each reading. A curve through all readings so far, clipped to the interval of each reading, has at
most the error of the interval, and mostly a much smaller one than its middle.

All engine speeds have the same weight, for any duration: an hour of cruising repeats one rounded reading, which would
bias the curve at that speed. A reading belongs to the engine speed at which it was sent; until the next one, a quarter
of a second later, the distance of the curve from the interval is held.

Bins, weights, ridge and memory were chosen by hand: half and twice of each move the mass by at most 0.17 sd, A and C by
at most 0.13 sd, on three simulated drives of 40 min (hills, highway, city).
"""

from typing import Any

import numpy as np

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

    def refine(self, engine_speed: Floats, reading: Floats, speed_then: Floats) -> Floats:
        """Friction (n,) as a share of reference torque at ``engine_speed`` [rad/s].

        ``reading`` (n,) is the last one at each moment, sent when the engine turned at ``speed_then`` [rad/s]. NaN
        where any is; the readings themselves until they have shown what their step is.
        """
        known = np.isfinite(engine_speed) & np.isfinite(reading) & np.isfinite(speed_then)
        speed, value = speed_then[known], reading[known]
        if len(self._levels) <= MAX_LEVELS:
            self._levels = np.union1d(self._levels, np.round(value, 6))
        cell = np.clip(speed / BIN_WIDTH, 0, BINS - 1).astype(np.int64)
        new = [np.bincount(cell, weights, BINS) for weights in (np.ones(len(cell)), speed, value)]
        self._sums = np.exp(-len(value) / MEMORY_READINGS) * self._sums + new
        if not 2 <= len(self._levels) <= MAX_LEVELS:
            return np.where(known, reading, np.nan)
        half_step = float(np.diff(self._levels).min()) / 2
        refined = np.full(len(reading), np.nan)
        then = self._curve(speed)
        missed = np.clip(then, value - half_step, value + half_step) - then
        refined[known] = self._curve(engine_speed[known]) + missed
        return refined

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads."""
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

    def _curve(self, engine_speed: Floats) -> Floats:
        count, speeds, values = self._sums[:, self._sums[0] > 0]
        powers = _powers(speeds / count)
        weighted = powers.T * np.minimum(count, MAX_BIN_WEIGHT)
        ridge = np.diag([0.0] + [RIDGE] * DEGREE)
        curve: Floats = _powers(engine_speed) @ np.linalg.solve(weighted @ powers + ridge, weighted @ (values / count))
        return curve


def _powers(engine_speed: Floats) -> Floats:
    return np.vander(engine_speed / SPEED_SCALE, DEGREE + 1, increasing=True)

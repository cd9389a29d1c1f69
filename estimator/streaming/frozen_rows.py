"""Rows whose speed and power no longer change on the move: a sender that repeats its last values.

A recorder or gateway whose source is gone may send the last values on at the usual rate, so that nothing is stale. The
values are then those of any moment, an acceleration perhaps, and have no noise: ten seconds of them have more weight in
a fit than the drive before. On a bus, speed or power change within tenths of a second: on 28 trips of a car they were
the same for 0.2 s at most, for 0.3 s on simulated trucks without noise. On one trip of that car they are for 441 s.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.samples import STEP, Rows
from estimator.signals import Floats, Mask, Quantity

# Share of a value by which means of equal readings differ: friction that is interpolated moves the power of a truck by
# 1e-6. One bit of a truck's speed is 4e-5 of it at 100 km/h.
ROUNDING = 1e-5
USUAL = 0.5  # s without a change that are not unusual; less than what is kept away from rows that are excluded
LONGEST = 10.0  # s; coarse signals, in steps of 1 km/h, are steady for a few seconds
MIN_SPEED = 1.0  # m/s: at a standstill nothing changes


class FrozenRows:
    """Tells frozen rows; those of a stretch without a change wait for its end. It does not matter how rows are cut."""

    def __init__(self) -> None:
        self._held: Rows | None = None  # they follow on those handed on, and have not changed for up to LONGEST
        self._held_still = np.empty(0)  # [s], for which each of them has not changed
        self._last = np.full(2, np.nan)  # speed [m/s] and power [W] of the row before the next one
        self._count = 0  # rows before that with the same values

    def feed(self, rows: Rows) -> Rows | None:
        """The next rows of the grid, at least one: those of which it is now known whether they are frozen."""
        still = np.concatenate([self._held_still, self._still(rows)])
        rows = rows if self._held is None else Rows.concatenate(self._held, rows)
        begun = rows.index - np.rint(still / STEP).astype(np.int64)  # where each stretch without a change began
        last = np.searchsorted(begun, begun, side="right") - 1
        waiting: Mask = (begun == begun[-1]) & (still > USUAL) & (still[-1] <= LONGEST)
        frozen = (still > USUAL) & (still[last] > LONGEST)
        known = len(rows) - int(waiting.sum())
        self._held, self._held_still = rows[known:] if known < len(rows) else None, still[known:]
        return _marked(rows, frozen, known)

    def finish(self) -> Rows | None:
        """The rows still waiting, when no row follows without a gap."""
        held, self._held, self._held_still = self._held, None, np.empty(0)
        self._last, self._count = np.full(2, np.nan), 0
        return None if held is None else _marked(held, np.zeros(len(held), dtype=bool), len(held))

    def _still(self, rows: Rows) -> Floats:
        """Time [s] (n,) since speed or power changed, 0 at a standstill; a value that is not known is a change."""
        values = np.column_stack([self._last, [rows.speed, rows.power]])
        is_same = np.all(np.abs(np.diff(values)) <= ROUNDING * np.abs(values[:, 1:]), axis=0)
        is_same &= rows.speed > MIN_SPEED
        place = np.arange(len(rows))
        changed: NDArray[np.int64] = np.maximum.accumulate(np.where(is_same, -1 - self._count, place))
        self._last, self._count = values[:, -1], int(place[-1] - changed[-1])
        return (place - changed) * STEP


def _marked(rows: Rows, frozen: Mask, number: int) -> Rows | None:
    """The first ``number`` of rows, with whether they are ``frozen`` (n,); None where there are none."""
    derived = {**rows.derived, Quantity.FROZEN: frozen.astype(float)}
    return replace(rows, derived=derived)[:number] if number else None

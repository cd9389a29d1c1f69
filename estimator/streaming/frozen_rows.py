"""Rows whose speed, power or engine speed does not change while the vehicle moves: a sender repeats its last values.

A recorder or gateway that has lost its source may repeat the last values at the usual rate, so that none is stale. Such
values may be of an acceleration, and have no noise: ten seconds of them have more weight in a fit than the drive
before. On a bus, speed or power changes within tenths of a second. Both were constant for at most 0.2 s on 28 trips of
a car, and for at most 0.3 s on simulated trucks without noise. On one trip of that car they are constant for 441 s.

One signal alone may be coarse, in steps of 1 km/h, or come once a second. Its share p of rows equal to the row before
is learnt. A run of n such rows has the probability p^n if rows are independent. They are not, so the limit comes from
recordings: -n log p is at most 94 on these, of an engine that sends once a second.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.samples import STEP, Rows
from estimator.signals import Floats, Mask, Quantity, Role

# Share of a value by which means of equal readings differ: friction that is interpolated moves the power of a truck by
# 1e-6. One bit of a truck's speed is 4e-5 of it at 100 km/h.
ROUNDING = 1e-5
USUAL = 0.5  # s without a change that are not unusual; less than what is kept away from rows that are excluded
LONGEST = 10.0  # s; coarse signals, in steps of 1 km/h, are steady for a few seconds
MIN_SPEED = 1.0  # m/s: at a standstill nothing changes
MAX_IMPROBABLE = 120.0  # -n log p of one signal alone
LEARNT = 20  # rows of a repetition, 2 s, from which p is learnt: a value that is held for longer is not usual
PRIOR_ROWS = 20.0  # rows of the prior of p, one of them a repetition


class FrozenRows:
    """Marks rows in which speed and power together, or speed, power or engine speed alone, are frozen.

    Rows of a stretch without a change wait until it ends. The result does not depend on how rows are cut into batches.
    """

    def __init__(self) -> None:
        self._parts = (
            _Repetition(lambda rows: np.array([rows.speed, rows.power]), is_coarse=True),
            _Repetition(lambda rows: rows.power[None], is_coarse=False),
            _Repetition(_engine_speed, is_coarse=False),  # friction that is still sent changes the power
            _Repetition(lambda rows: rows.speed[None], is_coarse=False),
        )

    def feed(self, rows: Rows) -> Rows | None:
        """Take the next rows, at least one; return those that are now decided, marked."""
        decided: Rows | None = rows
        for part in self._parts:
            decided = None if decided is None else part.feed(decided)
        return decided

    def finish(self) -> Rows | None:
        """Return the rows still waiting, before a gap or the end of the traffic."""
        held: Rows | None = None
        for part in self._parts:
            decided = None if held is None else part.feed(held)
            rest = [waiting for waiting in (decided, part.finish()) if waiting is not None]
            held = Rows.concatenate(*rest) if rest else None
        return held


class _Repetition:
    """Marks rows whose ``values`` (k, n) have been constant for too long.

    The limit is LONGEST where ``is_coarse``. Else a run is too long if it is improbable for this signal and not longer
    than LONGEST. Rows that are marked already stay marked.
    """

    def __init__(self, values: Callable[[Rows], Floats], is_coarse: bool) -> None:
        self._values, self._is_coarse = values, is_coarse
        self._held: Rows | None = None  # rows that wait: without a change for up to LONGEST
        self._held_still = np.empty(0)  # [s], for which each of them has not changed
        self._held_long = np.zeros(0, dtype=bool)  # whether that is too long
        self._last: Floats | None = None  # values (k,) of the row before the next one
        self._count = 0  # rows before that with the same values
        self._is_long = False  # of that row
        # Rows equal to the row before, and all rows, from which p is learnt.
        self._repeated, self._rows = 1.0, PRIOR_ROWS

    def feed(self, rows: Rows) -> Rows | None:
        """Take the next rows, at least one; return those that are now decided, marked."""
        new_still, new_long, may_be = self._time_since_change(rows)
        if self._held is None and not new_still.any():
            return _marked(rows, new_long, len(rows))
        still, long = np.concatenate([self._held_still, new_still]), np.concatenate([self._held_long, new_long])
        rows = rows if self._held is None else Rows.concatenate(self._held, rows)
        begun = rows.index - np.rint(still / STEP).astype(np.int64)  # where each stretch without a change began
        last = np.searchsorted(begun, begun, side="right") - 1
        waiting: Mask = (begun == begun[-1]) & (still > USUAL) & may_be & ~long[-1]
        frozen = (still > USUAL) & long[last]
        decided = len(rows) - int(waiting.sum())
        self._held = rows[decided:] if decided < len(rows) else None
        self._held_still, self._held_long = still[decided:], long[decided:]
        return _marked(rows, frozen, decided)

    def finish(self) -> Rows | None:
        """Return the rows still waiting, before a gap or the end of the traffic."""
        held, self._held, self._held_still, self._held_long = self._held, None, np.empty(0), np.zeros(0, dtype=bool)
        self._last, self._count, self._is_long = None, 0, False
        return None if held is None else _marked(held, np.zeros(len(held), dtype=bool), len(held))

    def _time_since_change(self, rows: Rows) -> tuple[Floats, Mask, bool]:
        """Time since a change [s] (n,), whether it is too long (n,), and whether the newest run can become too long.

        A standstill and an unknown value count as a change.
        """
        values = self._values(rows)
        previous = np.full(len(values), np.nan) if self._last is None else self._last
        values = np.column_stack([previous, values])
        is_same = np.all(np.abs(values[:, 1:] - values[:, :-1]) <= ROUNDING * np.abs(values[:, 1:]), axis=0)
        is_moving = rows.speed > MIN_SPEED
        is_same &= is_moving
        if not self._is_coarse:
            is_same &= (values[:, 1:] != 0).all(axis=0)  # no power while coasting
        self._last = values[:, -1]
        if not is_same.any():
            self._count, self._is_long = 0, False
            self._rows += 0.0 if self._is_coarse else float(is_moving.sum())
            return np.zeros(len(rows)), np.zeros(len(rows), dtype=bool), self._can_be_improbable()
        index = np.arange(len(rows))
        changed: NDArray[np.int64] = np.maximum.accumulate(np.where(is_same, -1 - self._count, index))
        run = index - changed
        reached = run * STEP > LONGEST if self._is_coarse else self._improbable(run, is_same, is_moving)
        newest = np.maximum.accumulate(np.where(reached, index, -1))
        long: Mask = (newest > changed) & (newest >= 0) | (changed < 0) & self._is_long
        self._count, self._is_long = int(run[-1]), bool(long[-1])
        return run * STEP, long, bool(run[-1] * STEP <= LONGEST) and self._can_be_improbable()

    def _improbable(self, run: NDArray[np.int64], is_same: Mask, is_moving: Mask) -> Mask:
        """Mask (n,) of runs that are improbable for this signal; updates the counts that p is learnt from."""
        repeated = self._repeated + np.cumsum(is_same & (run <= LEARNT))
        rows = self._rows + np.cumsum(is_moving & (run <= LEARNT))
        self._repeated, self._rows = float(repeated[-1]), float(rows[-1])
        improbable: Mask = (-run * np.log(repeated / rows) > MAX_IMPROBABLE) & (run * STEP <= LONGEST)
        return improbable

    def _can_be_improbable(self) -> bool:
        """True if a run of at most LONGEST can be too long."""
        return self._is_coarse or -LONGEST / STEP * np.log(self._repeated / self._rows) > MAX_IMPROBABLE


def _engine_speed(rows: Rows) -> Floats:
    unknown = np.full(len(rows), np.nan)
    return rows.context.get(Role.ENGINE_SPEED, unknown)[None]


def _marked(rows: Rows, frozen: Mask, number: int) -> Rows | None:
    """First ``number`` rows, marked where ``frozen`` (n,) or marked before; None if there are none."""
    if not number:
        return None
    if frozen.any() or Quantity.FROZEN not in rows.derived:
        derived = {**rows.derived, Quantity.FROZEN: (frozen | rows.frozen).astype(float)}
        rows = replace(rows, derived=derived)
    return rows if number == len(rows) else rows[:number]

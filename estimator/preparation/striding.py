"""Strides from rows of the time grid, batch by batch.

A stride starts where the one before ended, or where driving whose force is known begins again. Strides whose force is
not known cover the rest; they have the distance and the signals of the road.
"""

from collections import Counter
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from estimator.checkpoint.validation import State, optional, read
from estimator.errors import StateError
from estimator.preparation.admission import (
    ADMITTED,
    MAY_BRAKE,
    count_reasons,
    is_coasting,
    margin_of,
    near,
    row_reasons,
    shows_brakes,
)
from estimator.preparation.context import air_density, quantities_of
from estimator.preparation.past_speed import last_known
from estimator.samples import STEP, Rows
from estimator.settings import Admission
from estimator.signals import Floats, Mask, Quantity, Role
from estimator.strides import DURATION, EDGE, LAGS, ROWS, Strides

SPAN_ROWS = ROWS + EDGE  # rows that a stride is computed from
GAP_DISTANCE = 1e5  # m, assumed between two stretches of rows: their slopes are then independent
MIN_SPEED = 2.0  # m/s: below, force is a ratio of two small numbers, and a clutch may slip
_REACH = round(float(LAGS.max()) / STEP)
_WEIGHTS = np.convolve(np.convolve(np.ones(ROWS), np.ones(EDGE)), [0.5, 0.5])[:SPAN_ROWS] / (ROWS * EDGE)


class Strider:
    """Cuts rows into strides; the result does not depend on the batches.

    Parameters
    ----------
    admission
        Settings that decide which rows have a known force, and their margin to brake use and gear changes.
    wanted
        Quantities that the strides carry as context.
    start
        Time at which the drive began [s].
    """

    def __init__(self, admission: Admission, wanted: frozenset[Quantity], start: float) -> None:
        self._admission = msgspec.structs.replace(
            admission,
            minimum_speed_m_s=max(admission.minimum_speed_m_s, MIN_SPEED),
        )
        self.wanted, self._start = wanted, start
        self._rows: Rows | None = None  # from `margin` rows before the next stride on
        self._next = 0  # place in them where the next stride begins
        self._distance = 0.0  # [m] there
        self._speed = 0.0  # [m/s] last known before

    @property
    def waiting_rows(self) -> Rows | None:
        """Rows in no stride yet, and the margin of rows before them; None between two stretches of rows."""
        return self._rows

    def feed(self, rows: Rows, rejected: Counter[str]) -> Strides:
        """Take rows; return the strides that they complete. Rows in no stride of known force are counted by reason."""
        self._rows = rows if self._rows is None else Rows.concatenate(self._rows, rows)
        return self._cut(self._rows, SPAN_ROWS + ROWS + self._margin(self._rows), rejected)

    def finish(self, rejected: Counter[str]) -> Strides:
        """Return the strides still waiting, before a gap or at the end of the rows."""
        if self._rows is None:
            return Strides.none()
        strides = self._cut(self._rows, 0, rejected)
        unused = self._rows[self._next :]
        count_reasons(self._codes(unused)[0], rejected)
        self._rows, self._next, self._speed = None, 0, 0.0
        return strides

    def _margin(self, rows: Rows) -> int:
        """Number of rows before and after one that decide about it."""
        return max(margin_of(rows, self._admission), _REACH) + 1

    def _codes(self, rows: Rows) -> tuple[NDArray[np.int8], Mask]:
        """Code (n,) of the reason against each row, and mask (n,) of the rows with an open driveline."""
        margin = round(self._admission.stride_margin_s / STEP)
        codes = row_reasons(rows, self._admission)
        if not shows_brakes(rows):
            powerless = near(rows.power <= 0, margin_of(rows, self._admission))
            codes = np.where((codes == ADMITTED) & powerless, MAY_BRAKE, codes)
        coasting = is_coasting(rows, margin) & (rows.plausible_speed > MIN_SPEED)
        return np.where(coasting, np.int8(ADMITTED), codes), coasting

    def _cut(self, rows: Rows, ahead: int, rejected: Counter[str]) -> Strides:
        """Strides of all rows but the last ``ahead``, which wait for the rows after them."""
        codes, coasting = self._codes(rows)
        bad = np.concatenate([[0], np.cumsum(codes != ADMITTED)])
        clear = np.zeros(len(rows) + 1, dtype=bool)
        clear[: max(len(rows) - SPAN_ROWS + 1, 0)] = bad[SPAN_ROWS:] == bad[:-SPAN_ROWS]
        starts, lengths, begin = list[int](), list[int](), self._next
        while begin + max(ahead, ROWS) <= len(rows):
            onward = np.flatnonzero(clear[begin : begin + ROWS])
            span = ROWS if not len(onward) or onward[0] == 0 else int(onward[0])
            starts.append(begin)
            lengths.append(span)
            begin += span
        if not starts:
            return Strides.none()
        first, length = np.array(starts), np.array(lengths)
        is_known = clear[first]
        count_reasons(codes[starts[0] : begin][np.repeat(~is_known, length)], rejected)
        travelled, held = self._travelled(rows)
        strides = self._strides(rows, travelled, coasting, first, length, is_known)
        strides = strides[is_known | (strides.s1 > strides.s0)]  # at a standstill nothing of the road is measured
        self._distance, self._speed = float(travelled[begin]), float(held[begin - 1])
        first_waiting = max(begin - self._margin(rows), 0)
        self._rows, self._next = rows[first_waiting:], begin - first_waiting
        return strides

    def _strides(
        self,
        rows: Rows,
        travelled: Floats,
        coasting: Mask,
        first: NDArray[np.intp],
        length: NDArray[np.intp],
        is_known: Mask,
    ) -> Strides:
        at = np.minimum(first[:, None] + np.arange(SPAN_ROWS), len(rows) - 1)
        speed = rows.plausible_speed
        blank = np.full(len(rows), np.nan)

        def signal(role: Role) -> Floats:
            return rows.context.get(role, blank)

        def mean(values: Floats) -> Floats:
            weighted: Floats = (values[at] * _WEIGHTS).sum(axis=1)  # row by row: the same bits in any batch
            return weighted

        v0, v1 = speed[at[:, :EDGE]].mean(axis=1), speed[at[:, ROWS:]].mean(axis=1)
        a = (v1 - v0) / DURATION
        s0, s1 = (
            0.5 * (travelled[np.minimum(first + i + 1, len(rows))] + travelled[np.minimum(first + i + 2, len(rows))])
            for i in (0, ROWS)
        )
        slow = np.maximum(speed, MIN_SPEED)
        force = np.column_stack([mean(np.where(coasting, 0.0, _shifted(rows.power, lag) / slow)) for lag in LAGS])
        turns = signal(Role.ENGINE_SPEED)
        rise = signal(Role.GRADE)
        middle = at[:, SPAN_ROWS // 2]
        quantities = quantities_of(rows, self._start)
        return Strides(
            t=rows.t[first] + (SPAN_ROWS - 1) / 2 * STEP,
            rows=length.astype(np.int64),
            known=is_known,
            v0=v0,
            v1=v1,
            s0=s0,
            s1=np.maximum(s1, s0),
            a=a,
            speed_squared=mean(speed**2),
            force=force,
            gearing=mean(np.where(turns > 0, turns, np.nan) / slow),  # 0: what a gateway sends that knows none
            density=mean(air_density(rows)),
            altitude=mean(signal(Role.ALTITUDE)),
            grade=mean(rise / np.hypot(1.0, rise)),
            grade_offset_sd=mean(rows.derived.get(Quantity.GRADE_OFFSET_SD, blank)),
            gravity=np.where(is_known, mean(signal(Role.LONGITUDINAL_ACCELERATION)) - a, np.nan),
            context={q: quantities.get(q, blank)[middle] for q in sorted(self.wanted | self._fit_quantities(rows))},
        )

    def _fit_quantities(self, rows: Rows) -> frozenset[Quantity]:
        """Quantities of the rows that strides carry in any case, because the fit uses them."""
        return frozenset({Quantity.SPEED_STEP} & rows.derived.keys())

    def _travelled(self, rows: Rows) -> tuple[Floats, Floats]:
        """Distance [m] (n + 1,) at the bounds of rows, and speed [m/s] (n,), which holds its last known value.

        Both are 0 before the next stride; from there on, distance is the integral of the speed.
        """
        held = np.concatenate([np.zeros(self._next), last_known(rows.plausible_speed[self._next :], self._speed)])
        steps = np.concatenate([[self._distance], held[self._next :] * STEP])
        return np.concatenate([np.zeros(self._next), np.cumsum(steps)]), held

    def pause(self) -> None:
        """Add GAP_DISTANCE: the next rows follow a gap, and their slopes are independent of the previous ones."""
        self._distance += GAP_DISTANCE

    def state(self) -> dict[str, Any]:
        """State for `restore`."""
        return {
            "rows": None if self._rows is None else self._rows.state(),
            "next": self._next,
            "distance": self._distance,
            "speed": self._speed,
            "wanted": sorted(self.wanted),
            "start": self._start,
        }

    @classmethod
    def restore(cls, admission: Admission, state: State) -> "Strider":
        """Return a strider with a saved state.

        Raises
        ------
        StateError
            The state is not that of a strider.
        """
        strider = cls(admission, frozenset(read(state, "wanted", list[Quantity])), read(state, "start", float))
        strider._rows = optional(state, "rows", Rows.restore)
        strider._distance, strider._speed = read(state, "distance", float), read(state, "speed", float)
        held = 0 if strider._rows is None else len(strider._rows)
        strider._next = read(state, "next", int)
        if not 0 <= strider._next <= held:
            raise StateError("next: is out of range")
        return strider


def _shifted(values: Floats, lag: float) -> Floats:
    """Values (n,) shifted by ``lag`` [s], with the outermost held; an unknown later value is not taken."""
    index = np.arange(len(values)) + round(lag / STEP)
    later = values[np.clip(index, 0, len(values) - 1)]
    return np.where(np.isfinite(later), later, values)

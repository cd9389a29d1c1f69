"""Passes of places by a drive: mean slope of each pass, in a compact form that is stored with the drive's result."""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import sqrt

import numpy as np

from estimator.estimation.road_fit import RoadFit
from estimator.estimation.road_passes import mean_slopes
from estimator.model.road import ALPHAS
from estimator.model.road_scales import LENGTH, SLOPE
from estimator.road_map import Cells, cells_at, key_of, octant_of, place_of
from estimator.samples import STEP, Rows
from estimator.signals import Floats, Role
from estimator.streaming.course import Course
from estimator.strides import DURATION, Strides

KEPT_ROWS = 5  # one row in so many is kept for the positions of strides: 0.5 s
MAX_GAP = 10.0  # s between two positions, over which a line joins them
SAME_PASS = 1000.0  # m between strides in one place, beyond which the vehicle has come back
MIN_LENGTH = 25.0  # m in a place: less is a corner of its cell, whose slope is another one
# m by which the part of a cell that a pass crosses may differ from that of others: errors of positions, and the course,
# which lags by 25 m. Without it a tenth of the places was off by more than twice the sd.
PLACE_DOUBT = 10.0
UNIT = 1e-5  # of kept slopes and sds, rise over run: a centimetre on a kilometre


@dataclass(frozen=True, kw_only=True)
class Passes:
    """Passes of places, as tuples (k,) of integers; JSON takes some 20 bytes a pass.

    ``row``, ``column`` and ``octant`` of `road_map` are differences from the previous pass. ``slope``, ``own`` sd and
    ``common`` sd are in UNIT, see `road_passes`.
    """

    row: tuple[int, ...] = ()
    column: tuple[int, ...] = ()
    octant: tuple[int, ...] = ()
    slope: tuple[int, ...] = ()
    own: tuple[int, ...] = ()
    common: tuple[int, ...] = ()

    @classmethod
    def of(cls, key: Cells, slope: Floats, independent: Floats, common: Floats) -> "Passes":
        """Encode keys of places (k,), slopes (k,), and own and common sds (k,)."""
        places = [np.diff(numbers, prepend=0) for numbers in place_of(key)]
        values = [
            np.round(column / UNIT).astype(np.int64)
            for column in (slope, np.maximum(independent, UNIT), np.maximum(common, UNIT))
        ]
        return cls(**{field.name: tuple(v.tolist()) for field, v in zip(fields(cls), [*places, *values], strict=True)})

    @property
    def keys(self) -> Cells:
        """Keys (k,) of the places."""
        row, column, octant = (np.cumsum(np.array(v, np.int64)) for v in (self.row, self.column, self.octant))
        return key_of(row, column, octant)

    @property
    def values(self) -> tuple[Floats, Floats, Floats]:
        """Slopes, rise over run, own and common sds (k,) [1]."""
        slope, independent, common = (UNIT * np.array(v, float) for v in (self.slope, self.own, self.common))
        return slope, independent, common

    @classmethod
    def joined(cls, parts: "Sequence[Passes]") -> "Passes":
        """Concatenate passes."""
        if not parts:
            return cls()
        values = (np.concatenate(columns) for columns in zip(*(part.values for part in parts), strict=True))
        return cls.of(np.concatenate([part.keys for part in parts]), *values)


class Places:
    """Positions and directions of travel of a drive, taken from its rows."""

    def __init__(self) -> None:
        self._course = Course()
        self._parts: list[Floats] = []

    def add(self, rows: Rows) -> None:
        """Add the next rows."""
        course = self._course.feed(rows)
        latitude, longitude = (rows.context.get(role) for role in (Role.LATITUDE, Role.LONGITUDE))
        if latitude is None or longitude is None:
            return
        kept = np.isfinite(latitude) & np.isfinite(longitude) & np.isfinite(course) & (rows.index % KEPT_ROWS == 0)
        self._parts.append(np.column_stack([rows.index * STEP, latitude, longitude, course])[kept])

    def under(self, strides: Strides) -> Cells:
        """Key (n,) of the place of each stride; -1 if unknown."""
        key = np.full(len(strides), -1, np.int64)
        positions = np.concatenate([np.empty((0, 4)), *self._parts])
        if len(positions) < 2:
            return key
        t, latitude, longitude, course = positions.T
        after = np.clip(np.searchsorted(t, strides.t), 1, len(t) - 1)
        near = (strides.t >= t[after - 1]) & (strides.t <= t[after]) & (t[after] - t[after - 1] <= MAX_GAP)
        row, column = cells_at(*(np.interp(strides.t, t, angle) for angle in (latitude, longitude)))
        key[near] = key_of(row, column, octant_of(course[after]))[near]
        return key


def passes_of(strides: Strides, fit: RoadFit, places: Places, start: float) -> Passes:
    """Passes of places by the strides of a fit, from time ``start`` [s] on."""
    key = np.where(strides.t >= start, places.under(strides), -1)
    there = np.flatnonzero(key >= 0)
    if not len(there):
        return Passes()
    there = there[np.lexsort((strides.s0[there], key[there]))]  # by place, and there by distance
    begins = (np.diff(key[there], prepend=-1) != 0) | (np.diff(strides.s0[there], prepend=0.0) > SAME_PASS)
    number = np.cumsum(begins) - 1
    length = np.bincount(number, (strides.s1 - strides.s0)[there])
    long = length >= MIN_LENGTH
    parts = np.full(len(strides), -1, np.int64)
    parts[there] = np.where(long[number], (np.cumsum(long) - 1)[number], -1)
    shown = mean_slopes(strides, fit, parts)
    is_known = np.isfinite(shown.slope) & np.isfinite(shown.common)
    sd, distance = fit.scales.values[[SLOPE, LENGTH]].tolist()
    speed = length[long] / np.bincount(number)[long] / DURATION
    nu = max(fit.scales.alpha, ALPHAS[0]) - 0.5
    gradient = sqrt(nu / (nu - 1)) * sd / distance * fit.scales.warping(speed)  # 1/m, sd of that of the process
    independent = np.hypot(shown.own[is_known], PLACE_DOUBT * gradient[is_known])
    run = np.sqrt(1 - np.clip(shown.slope[is_known], -0.5, 0.5) ** 2)  # sine to rise over run
    return Passes.of(
        key[there][begins][long][is_known], shown.slope[is_known] / run, independent, shown.common[is_known]
    )

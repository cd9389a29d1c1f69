"""Direction of travel from positions, row by row, and the slope that a map gives for it."""

from dataclasses import replace

import numpy as np

from estimator.road_map import RoadMap
from estimator.samples import STEP, Rows
from estimator.signals import Floats, Quantity, Role
from estimator.units import EARTH_RADIUS

BASE = 50.0  # m behind, to where the direction is taken from: errors of 2 m at both ends turn it by 3 degrees
MAX_BASE = 2 * BASE  # m: beyond, positions were missing
MIN_STRAIGHT = 0.5 * BASE  # m as the crow flies: shorter, the vehicle has turned round
MIN_SPEED = 0.5  # m/s: below, a position says nothing new


class Course:
    """Finds the direction of travel; the result does not depend on the batches."""

    def __init__(self) -> None:
        self._next: int | None = None  # index of the row that would follow without a gap
        self._forget()

    def _forget(self) -> None:
        self._distance = 0.0  # m, since the last gap
        self._passed = np.empty((0, 3))  # distance [m], latitude, longitude [rad] of the last moments in motion

    def feed(self, rows: Rows) -> Floats:
        """Direction [rad] (n,), clockwise from north, at the next rows; NaN where it is not known."""
        if rows.index[0] != self._next:
            self._forget()
        self._next = int(rows.index[-1]) + 1
        blank = np.full(len(rows), np.nan)
        latitude, longitude = (rows.context.get(role, blank) for role in (Role.LATITUDE, Role.LONGITUDE))
        steps = np.where(rows.speed > MIN_SPEED, rows.speed, 0.0) * STEP
        along = np.cumsum(np.concatenate([[self._distance], steps]))[1:]
        self._distance = float(along[-1])
        is_known = np.isfinite(latitude) & np.isfinite(longitude)
        here = np.column_stack([along, latitude, longitude])
        passed = np.concatenate([self._passed, here[is_known & (steps > 0)]])
        course = np.full(len(rows), np.nan)
        if len(passed):
            course[is_known] = _courses(here[is_known], passed)
            first = np.searchsorted(passed[:, 0], self._distance - BASE, side="right") - 1
            self._passed = passed[max(first, 0) :]
        return course


def _courses(here: Floats, passed: Floats) -> Floats:
    """Direction [rad] (n,) to points ``here`` (n, 3) from the points ``passed`` (k, 3) BASE before; NaN if unknown."""
    origin = np.searchsorted(passed[:, 0], here[:, 0] - BASE, side="right") - 1
    way = here - passed[np.maximum(origin, 0)]
    north, east = EARTH_RADIUS * way[:, 1], EARTH_RADIUS * np.cos(here[:, 1]) * way[:, 2]
    sure = (origin >= 0) & (way[:, 0] <= MAX_BASE) & (np.hypot(north, east) >= MIN_STRAIGHT)
    return np.where(sure, np.arctan2(east, north), np.nan)


class MapGrade:
    """Adds the slope of a map to rows as their grade signal; adds nothing where the map has no value."""

    def __init__(self, road_map: RoadMap) -> None:
        self._map, self._course = road_map, Course()

    def feed(self, rows: Rows) -> Rows:
        """Return the next rows with their grade."""
        course = self._course.feed(rows)
        blank = np.full(len(rows), np.nan)
        latitude, longitude = (rows.context.get(role, blank) for role in (Role.LATITUDE, Role.LONGITUDE))
        grade, offset_sd = self._map.at(latitude, longitude, course)
        if not np.isfinite(grade).any():
            return rows
        derived = {**rows.derived, Quantity.GRADE_OFFSET_SD: offset_sd}
        return replace(rows, context={**rows.context, Role.GRADE: grade}, derived=derived)

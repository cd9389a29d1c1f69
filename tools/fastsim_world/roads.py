"""Routes: published speeds and grades as roads at 10 Hz."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from estimator.signals import Floats

STEP = 0.1  # s, of the simulation
CORNER = 1.0  # s, width of the Gaussian that rounds a table's corners
BRAKING = 1.2  # m/s^2, limit of the deceleration of a route's speeds
STANDING = 0.01  # m/s, slower is standstill: the tail of the Gaussian
MILE, FOOT, MPH = 1609.344, 0.3048, 0.44704  # m, m, m/s
SURVEY_STEP, SURVEY_WIDTH = 10.0, 150.0  # m, for grade from surveyed elevation


@dataclass(frozen=True)
class Road:
    """Speeds ``v`` [m/s] asked for and ``grade`` [1] in steps of STEP, both (n,)."""

    v: Floats
    grade: Floats


def _table(folder: Path, name: str, rows: slice = slice(None)) -> Floats:
    return np.genfromtxt(folder / f"{name}.csv", delimiter=",", skip_header=1)[rows]


def _long_haul(folder: Path, start: int) -> Floats:
    return _table(folder, "longHaulDriveCycle", slice(start, start + 4500))


def _gem(folder: Path) -> Floats:
    """The phases of the greenhouse-gas rule one after the other, on a road that is driven twice."""
    phases = ("EPA_Ph2_transient", "EPA_Ph2_urban_highway_55mph", "EPA_Ph2_rural_interstate_65mph")
    once = np.concatenate([_table(folder, name)[:, 1:3] for name in phases])
    twice = np.concatenate([once, once])
    return np.column_stack([np.arange(len(twice)), twice])


def _mountain(folder: Path, name: str) -> Floats:
    """Speeds [mph] over miles and feet as surveyed; elevation becomes grade along the road."""
    t, speed, miles, feet = _table(folder, name).T
    distance = miles * MILE
    along = np.arange(distance[0], distance[-1], SURVEY_STEP)
    moved = np.flatnonzero(np.diff(distance, prepend=-1.0) > 0)
    surveyed = np.interp(along, distance[moved], feet[moved] * FOOT)
    slope = np.gradient(gaussian_filter1d(surveyed, SURVEY_WIDTH / SURVEY_STEP, mode="nearest"), SURVEY_STEP)
    return np.column_stack([t, speed * MPH, np.interp(distance, along, slope)])


ROUTES: dict[str, Callable[[Path], Floats]] = {
    "long-haul": lambda folder: _long_haul(folder, 4_500),
    "long-haul-hilly": lambda folder: _long_haul(folder, 0),
    "long-haul-stops": lambda folder: _long_haul(folder, 31_500),
    "gem": _gem,
    "vail": lambda folder: _mountain(folder, "nrel2vail_raw"),
    "vail-back": lambda folder: _mountain(folder, "vail2nrel_raw"),
    "flat": lambda folder: _table(folder, "regional_haul", slice(9_000, 15_000)),
}


def road_of(table: Floats) -> Road:
    """A table of time [s], speed [m/s] and grade (m, 3) at 10 Hz, smoothed and with limited braking."""
    t = np.arange(table[0, 0], table[-1, 0], STEP)
    v, grade = (np.interp(t, table[:, 0], table[:, k]) for k in (1, 2))
    for i in range(len(v) - 2, -1, -1):
        v[i] = min(v[i], v[i + 1] + BRAKING * STEP)
    rounded = gaussian_filter1d(v, CORNER / STEP)
    rounded[rounded < STANDING] = 0.0
    return Road(rounded, gaussian_filter1d(grade, CORNER / STEP))

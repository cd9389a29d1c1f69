"""Roads by distance: sections with a speed to drive, stops with a dwell time, grade and bends."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import cycle
from math import sqrt
from typing import Literal

import numpy as np

from estimator.signals import Floats
from estimator.simulation.bends import CURVE_SPACING, Bend, curvature_of
from estimator.simulation.noise import smooth

KMH = 1 / 3.6  # m/s
GRADE_SPACING = 20.0  # m between points of the grade profile
HILL_LENGTH = 500.0  # m over which the grade changes

RoadKind = Literal["urban", "mixed", "highway"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Route:
    """Road of a drive.

    ``section_start`` (k,) [m] ascends from 0, with ``section_speed`` (k,) [m/s]. ``stop_position`` (j,) [m] ascends to
    the end of the road, with ``stop_dwell`` (j,) [s]. ``grade`` (n,) is the rise over run [1] every ``GRADE_SPACING``.
    ``curvature`` (c,) [1/m] is positive to the left, every ``CURVE_SPACING``. ``start_heading`` [rad] is clockwise from
    north. A road driven out and back, or in laps, has ``place`` (n,) [m], the position along the ground at the points
    of ``grade``, and the length of a ``lap`` [m].
    """

    section_start: Floats
    section_speed: Floats
    stop_position: Floats
    stop_dwell: Floats
    grade: Floats
    curvature: Floats = field(default_factory=lambda: np.zeros(2))
    start_heading: float = 0.0
    place: Floats | None = None
    lap: float | None = None

    @property
    def length(self) -> float:
        """Length of the road [m]."""
        return float(self.stop_position[-1])

    @property
    def altitude(self) -> Floats:
        """Altitude [m] (n,) above the start, at the points of ``grade``."""
        sine = self.grade / np.hypot(1.0, self.grade)
        return np.concatenate([[0.0], np.cumsum(0.5 * GRADE_SPACING * (sine[1:] + sine[:-1]))])

    @property
    def heading(self) -> Floats:
        """Heading [rad] (n,), clockwise from north and not wrapped, at the points of ``curvature``."""
        turned = np.cumsum(0.5 * CURVE_SPACING * (self.curvature[1:] + self.curvature[:-1]))
        return self.start_heading - np.concatenate([[0.0], turned])


@dataclass(frozen=True, slots=True, kw_only=True)
class _Road:
    speeds: tuple[float, ...]  # km/h
    section: tuple[float, float]  # m, shortest and longest
    stop: float  # probability at the end of a section
    bend: float  # probability of a slow bend or slow zone after a section
    bend_speed: float  # km/h
    bend_length: float  # m
    bend_angle: tuple[float, float]  # rad, smallest and largest change of heading in a bend


_URBAN = _Road(
    speeds=(30, 40, 50, 50, 60),
    section=(150, 700),
    stop=0.5,
    bend=0.15,
    bend_speed=18,
    bend_length=25,
    bend_angle=(1.2, 1.8),
)
_RURAL = _Road(
    speeds=(60, 70, 80), section=(600, 2500), stop=0.2, bend=0.25, bend_speed=35, bend_length=80, bend_angle=(0.5, 1.5)
)
_HIGHWAY = _Road(
    speeds=(80, 85, 85, 90),
    section=(2000, 7000),
    stop=0.0,
    bend=0.2,
    bend_speed=60,
    bend_length=800,
    bend_angle=(0.6, 2.4),
)
_BLOCKS: dict[RoadKind, tuple[tuple[_Road, float], ...]] = {  # kind of road, length of a block [m]
    "urban": ((_URBAN, 10e3),),
    "mixed": ((_URBAN, 5e3), (_RURAL, 6e3), (_HIGHWAY, 12e3), (_RURAL, 5e3)),
    "highway": ((_URBAN, 1e3), (_RURAL, 3e3), (_HIGHWAY, 45e3)),
}


# Lengths over which the grade of real roads changes [m], and their shares of its variance. Fitted to the shares of
# waves of 40-200 m, 0.2-0.8, 0.8-3.2, 3.2-12.8 km and longer in the mission profiles of VECTO (2015): urban 9, 36, 26,
# 28, 1 % (mean of four profiles), regional 2, 26, 69, 3, 1 % (one), long haul 0, 3, 17, 43, 38 % (mean of three).
MEASURED_WAVES: dict[RoadKind, tuple[tuple[float, float], ...]] = {
    "urban": ((60.0, 0.54), (250.0, 0.20), (1000.0, 0.26)),
    "mixed": ((60.0, 0.1), (250.0, 0.9)),
    "highway": ((250.0, 0.11), (1000.0, 0.60), (4000.0, 0.29)),
}


def generate_route(
    kind: RoadKind,
    length: float,
    rng: np.random.Generator,
    grade_sd: float = 0.0,
    waves: Sequence[tuple[float, float]] = ((HILL_LENGTH, 1.0),),
) -> Route:
    """Generate a road at random.

    Parameters
    ----------
    kind
        ``"urban"``, ``"mixed"`` or ``"highway"``.
    length
        Length of the road [m]; the truck stays at its end.
    rng
        Source of randomness.
    grade_sd
        Standard deviation of the grade, rise over run [1]; flat by default.
    waves
        Lengths [m] over which the grade changes, and their shares of its variance [1]. Those of real roads are
        `MEASURED_WAVES`.
    """
    starts: list[float] = []
    speeds: list[float] = []
    stops: list[float] = []
    dwells: list[float] = []
    bends: list[Bend] = []
    position = 0.0
    for road in _roads(kind):
        if position >= length:
            break
        starts.append(position)
        speeds.append(float(rng.choice(road.speeds)) * KMH)
        position += rng.uniform(*road.section)
        if rng.random() < road.bend:
            starts.append(position)
            speeds.append(road.bend_speed * rng.uniform(0.85, 1.15) * KMH)
            position += road.bend_length * rng.uniform(0.7, 1.5)
            bends.append(Bend(starts[-1], position, speeds[-1], road.bend_angle))
        if rng.random() < road.stop and position < length:
            stops.append(position)
            dwells.append(3.0 + rng.exponential(16.0))
    points = int(length / GRADE_SPACING) + 2
    return Route(
        section_start=np.array(starts),
        section_speed=np.array(speeds),
        stop_position=np.array([*stops, length]),
        stop_dwell=np.array([*dwells, np.inf]),
        grade=_grade(points, grade_sd, waves, rng),
        curvature=curvature_of(np.array(starts), np.array(speeds), bends, length, rng),
        start_heading=rng.uniform(0.0, 2 * np.pi),
    )


def _grade(points: int, sd: float, waves: Sequence[tuple[float, float]], rng: np.random.Generator) -> Floats:
    """Grade [1] (points,) with a standard deviation, as a sum of processes over different lengths."""
    grade = np.zeros(points)
    for length, share in waves:
        grade += smooth(points, sd * sqrt(share), length / GRADE_SPACING / 2, rng)
    return grade


def _roads(kind: RoadKind) -> Iterator[_Road]:
    """Yield the kind of road of consecutive sections."""
    for road, block in cycle(_BLOCKS[kind]):
        for _ in range(max(1, round(block / (sum(road.section) / 2)))):
            yield road

"""Shapes of a drive on a road: one way, out and back, laps; position by time, and stops for loading."""

from dataclasses import replace
from typing import Literal

import numpy as np

from estimator.signals import Floats
from estimator.simulation.bends import CURVE_SPACING
from estimator.simulation.driver import GRID, speeds_ahead
from estimator.simulation.route import GRADE_SPACING, RoadKind, Route, generate_route

Shape = Literal["one-way", "out-and-back", "loop"]

METRES_PER_SECOND = 2000.0 / 60.0  # of road, 120 km/h: longer than any drive
LAP_TIME = 1200.0  # s, of a loop
TURN_LENGTH, TURN_SPEED, TURN_DWELL = 40.0, 4.0, 20.0  # m, m/s, s: a U-turn on a yard
HALF_WAY = 0.48  # of the time when to turn round: hills and loads make a drive longer than planned
MOVING_OFF = 20.0  # s lost by gaining speed after a stop
MAX_STOP_DISTANCE = 1500.0  # m, between a wanted stop and one of the road that is used for it


def plan_route(kind: RoadKind, duration: float, rng: np.random.Generator, shape: Shape = "one-way") -> Route:
    """Generate a road of a kind that is long enough for ``duration`` [s], driven in a shape."""
    return shaped(generate_route(kind, duration * METRES_PER_SECOND, rng), duration, shape)


def shaped(road: Route, duration: float, shape: Shape) -> Route:
    """Shape a road: one way; out and back, home after about ``duration`` [s]; or its first part in laps."""
    if shape == "out-and-back":
        return out_and_back(road, place_at(road, HALF_WAY * duration))
    if shape == "loop":
        return laps(road, place_at(road, min(LAP_TIME, 0.4 * duration)), road.length)
    return road


def place_at(route: Route, time: float) -> float:
    """Approximate position [m] of a driver ``time`` [s] after the start."""
    distance = np.arange(0.0, route.length, GRID)
    seen = np.maximum(0.95 * speeds_ahead(route, 0.17, 0.55)[: len(distance)], 1.5)
    seconds = np.cumsum(GRID / seen)
    for stop, dwell in zip(route.stop_position[:-1], route.stop_dwell[:-1], strict=True):
        seconds[distance >= stop] += dwell + MOVING_OFF
    return float(np.interp(time, seconds, distance))


def out_and_back(route: Route, turn: float) -> Route:
    """Drive to ``turn`` [m], turn round, and return on the same road, with grades and bends reversed."""
    turn = GRADE_SPACING * round(turn / GRADE_SPACING)
    home = 2 * turn + TURN_LENGTH
    there = route.section_start < turn
    start, speed = route.section_start[there], route.section_speed[there]
    section_end = np.append(start[1:], turn)
    stops = (route.stop_position > 100.0) & (route.stop_position < turn - 100.0)
    stop, dwell = route.stop_position[stops], route.stop_dwell[stops]
    grade = route.grade[: round(turn / GRADE_SPACING) + 1]
    curvature = route.curvature[: round(turn / CURVE_SPACING) + 1]
    position = GRADE_SPACING * np.arange(len(grade))
    yard, curved_yard = round(TURN_LENGTH / GRADE_SPACING) - 1, round(TURN_LENGTH / CURVE_SPACING) - 1
    u_turn = np.full(curved_yard, np.pi / (curved_yard * CURVE_SPACING))
    return Route(
        section_start=np.concatenate([start, [turn], (home - section_end)[::-1]]),
        section_speed=np.concatenate([speed, [TURN_SPEED], speed[::-1]]),
        stop_position=np.concatenate([stop, [turn], (home - stop)[::-1], [home]]),
        stop_dwell=np.concatenate([dwell, [TURN_DWELL], dwell[::-1], [np.inf]]),
        grade=np.concatenate([grade, np.zeros(yard), -grade[::-1], [0.0]]),
        curvature=np.concatenate([curvature, u_turn, -curvature[::-1], [0.0]]),
        start_heading=route.start_heading,
        place=np.concatenate([position, np.full(yard, turn), position[::-1], [0.0]]),
    )


def laps(route: Route, lap: float, length: float) -> Route:
    """Repeat the first ``lap`` [m] of a road as a closed loop for ``length`` [m].

    Over a lap, the heading turns by a whole circle and the altitude returns to its initial value.
    """
    lap = GRADE_SPACING * round(lap / GRADE_SPACING)
    rounds = int(np.ceil(length / lap))
    sections = route.section_start < lap
    stops = (route.stop_position > 100.0) & (route.stop_position < lap - 100.0)
    grade = route.grade[: round(lap / GRADE_SPACING)]
    curvature = route.curvature[: round(lap / CURVE_SPACING)]
    curvature = curvature + (2 * np.pi / lap - curvature.mean())
    start = np.tile(route.section_start[sections], rounds) + lap * np.repeat(np.arange(rounds), sections.sum())
    stop = np.tile(route.stop_position[stops], rounds) + lap * np.repeat(np.arange(rounds), stops.sum())
    return Route(
        section_start=start,
        section_speed=np.tile(route.section_speed[sections], rounds),
        stop_position=np.append(stop, rounds * lap),
        stop_dwell=np.append(np.tile(route.stop_dwell[stops], rounds), np.inf),
        grade=np.concatenate([np.tile(grade - grade.mean(), rounds), [0.0, 0.0]]),
        curvature=np.concatenate([np.tile(curvature, rounds), [0.0, 0.0]]),
        start_heading=route.start_heading,
        place=np.concatenate([np.tile(GRADE_SPACING * np.arange(len(grade)), rounds), [0.0, 0.0]]),
        lap=lap,
    )


def with_stop(route: Route, time: float, dwell: float) -> tuple[Route, float]:
    """Add a stop of ``dwell`` [s] about ``time`` [s] after the start; returns the road and the stop's position [m]."""
    wanted = GRID * round(place_at(route, time) / GRID)
    stops, dwells = route.stop_position, route.stop_dwell.copy()
    nearest = int(np.argmin(np.abs(stops[:-1] - wanted))) if len(stops) > 1 else -1
    if nearest >= 0 and abs(stops[nearest] - wanted) < MAX_STOP_DISTANCE:
        dwells[nearest] = dwell
        return replace(route, stop_dwell=dwells), float(stops[nearest])
    i = int(np.searchsorted(stops, wanted))
    longer = replace(route, stop_position=np.insert(stops, i, wanted), stop_dwell=np.insert(dwells, i, dwell))
    return longer, wanted


def on_the_ground(route: Route, profile: Floats) -> tuple[Floats, Floats]:
    """Map a ``profile`` of the ground, every ``GRADE_SPACING``, to the road (n,); and sense of driving +-1 (n,)."""
    if route.place is None:
        return profile[: len(route.grade)], np.ones(len(route.grade))
    met = profile[np.round(route.place / GRADE_SPACING).astype(int)]
    step = np.diff(route.place, prepend=0.0)
    return met, np.where((step < 0.0) & (step > -2 * GRADE_SPACING), -1.0, 1.0)

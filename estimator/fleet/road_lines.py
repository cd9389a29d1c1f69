"""Places of a learned road one behind the other, as they are driven.

A place is followed by the nearest place ahead of its direction of travel whose direction differs by at most an eighth
of a turn; places that are passed about as often are taken first, for a road at the edge of two cells is now and then in
the cell beside it. Several places may be followed by the same one: the longest way to its end has it, and the others
end there. So each place is in one line.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from math import pi

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from estimator.road_map import CELL, COURSES, Cells, cells_at, centre_of, key_of, place_of
from estimator.signals import Floats
from estimator.units import EARTH_RADIUS

REACH = 2  # cells to a place that follows: more are a gap in the line
MAX_TURN = pi / 4  # rad, of the way to the next place against the direction of travel
ALIKE = 0.5  # of the passes of a place, in one that is passed about as often
SMOOTHED = 5  # places: from cell to cell the way is a zigzag
NONE = -1


@dataclass(frozen=True)
class RoadLine:
    """Numbers of places (k,) in the order of driving, and the distance [m] (k,) along a smooth line near them."""

    places: NDArray[np.int64]
    distance: Floats


def road_lines(key: Cells, passes: NDArray[np.int64]) -> list[RoadLine]:
    """The lines of places with these keys (n,), which ascend, and numbers of ``passes`` (n,); the longest first."""
    row, column, _ = place_of(key)
    latitude, longitude = centre_of(row, column)
    lines = (_line(places, latitude[places], longitude[places]) for places in _ways(_followers(key, passes)))
    return sorted(lines, key=lambda line: -line.distance[-1])


def _line(places: NDArray[np.int64], latitude: Floats, longitude: Floats) -> RoadLine:
    """The line of places with centres at these positions [rad] (k,)."""
    turns = (longitude - longitude[0]) / (2 * pi)
    east = 2 * pi * (turns - np.round(turns)) * np.cos(latitude)
    steps = [np.diff(_smooth(EARTH_RADIUS * each)) for each in (latitude, east)]
    return RoadLine(places, np.concatenate([[0.0], np.cumsum(np.hypot(*steps))]))


def _smooth(x: Floats) -> Floats:
    """Means (k,) of each SMOOTHED values of ``x`` (k,); the first and the last go on."""
    half = SMOOTHED // 2
    means: Floats = sliding_window_view(np.pad(x, half, mode="edge"), SMOOTHED).mean(axis=1)
    return means


def _followers(key: Cells, passes: NDArray[np.int64]) -> NDArray[np.int64]:
    """The place (n,) that follows each, NONE where there is none."""
    row, column, octant = place_of(key)
    latitude, longitude = centre_of(row, column)
    follower = np.full(len(key), NONE)
    for least, (north, east, turn) in product((ALIKE, 0.0), _steps()):
        off = (np.arctan2(east, north) - octant * (2 * pi / COURSES) + pi) % (2 * pi) - pi
        is_bend = not north and not east  # within the cell
        ends = np.flatnonzero((follower == NONE) & (is_bend | (np.abs(off) <= MAX_TURN + 1e-9)))
        there = latitude[ends] + north * CELL / EARTH_RADIUS
        beside = longitude[ends] + east * CELL / EARTH_RADIUS / np.cos(there)
        wanted = key_of(*cells_at(there, beside), (octant[ends] + turn) % COURSES)
        at = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
        fits = (key[at] == wanted) & (passes[at] >= least * passes[ends])
        if is_bend:
            fits &= follower[at] != NONE  # of the two directions in a cell one goes on
        follower[ends[fits]] = at[fits]
    return follower


def _steps() -> list[tuple[int, int, int]]:
    """Cells to the north and to the east, and eighths of a turn, of places that may follow, the likeliest first."""
    ways = [(north, east) for north, east in product(range(-REACH, REACH + 1), repeat=2) if north or east]
    nearest = sorted(ways, key=lambda way: np.hypot(*way))
    return [*((*way, turn) for way in nearest for turn in (0, -1, 1)), (0, 0, -1), (0, 0, 1)]


def _ways(follower: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Places in the order in which they follow each other, each once: the longest ways have them first."""
    after, is_used = follower.tolist(), [False] * len(follower)
    for start in np.argsort(-_lengths(after), kind="stable").tolist():
        line, place = [], start
        while place != NONE and not is_used[place]:
            is_used[place] = True
            line.append(place)
            place = after[place]
        if line:
            yield np.array(line)


def _lengths(after: list[int]) -> NDArray[np.int64]:
    """Number of places (n,) from each to the end of its way; a ring is cut where it is met again."""
    lengths = [0] * len(after)
    for start in range(len(after)):
        way, place = [], start
        while place != NONE and not lengths[place]:
            lengths[place] = 1  # until the end of the way is known
            way.append(place)
            place = after[place]
        length = 0 if place == NONE else lengths[place]
        for passed in reversed(way):
            length += 1
            lengths[passed] = length
    return np.array(lengths, dtype=np.int64)

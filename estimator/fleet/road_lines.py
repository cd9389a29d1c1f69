"""Lines of places of a learned road, in the order of driving.

A place is followed by the nearest place in its direction of travel whose direction differs by at most an eighth of a
turn. Places that are passed about as often have precedence, because a road at the edge of two cells is sometimes
assigned to the neighbouring cell. If several places are followed by the same place, it belongs to the longest line, and
the others end there. Each place is therefore in one line.
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
    """Numbers of places (k,) in the order of driving, and distance [m] (k,) along a smoothed line through them."""

    places: NDArray[np.int64]
    distance: Floats


def road_lines(key: Cells, passes: NDArray[np.int64]) -> list[RoadLine]:
    """Lines of places, the longest first, from their ascending keys (n,) and numbers of ``passes`` (n,)."""
    row, column, _ = place_of(key)
    latitude, longitude = centre_of(row, column)
    lines = (_line(places, latitude[places], longitude[places]) for places in _lines(_followers(key, passes)))
    return sorted(lines, key=lambda line: -line.distance[-1])


def _line(places: NDArray[np.int64], latitude: Floats, longitude: Floats) -> RoadLine:
    """Line of places with centres at these positions [rad] (k,)."""
    turns = (longitude - longitude[0]) / (2 * pi)
    east = 2 * pi * (turns - np.round(turns)) * np.cos(latitude)
    steps = [np.diff(_smooth(EARTH_RADIUS * coordinate)) for coordinate in (latitude, east)]
    return RoadLine(places, np.concatenate([[0.0], np.cumsum(np.hypot(*steps))]))


def _smooth(x: Floats) -> Floats:
    """Moving average (k,) of ``x`` (k,) over SMOOTHED values, padded with the first and last value."""
    half = SMOOTHED // 2
    means: Floats = sliding_window_view(np.pad(x, half, mode="edge"), SMOOTHED).mean(axis=1)
    return means


def _followers(key: Cells, passes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Number (n,) of the place that follows each place; NONE if there is none."""
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
    """Offsets of places that may follow, the likeliest first: cells to the north and east, and eighths of a turn."""
    ways = [(north, east) for north, east in product(range(-REACH, REACH + 1), repeat=2) if north or east]
    nearest = sorted(ways, key=lambda way: np.hypot(*way))
    return [*((*way, turn) for way in nearest for turn in (0, -1, 1)), (0, 0, -1), (0, 0, 1)]


def _lines(follower: NDArray[np.int64]) -> Iterator[NDArray[np.int64]]:
    """Yield lines of places in order, the longest first; each place is in one line."""
    after, is_used = follower.tolist(), [False] * len(follower)
    for start in np.argsort(-_lengths(after), kind="stable").tolist():
        line, number = [], start
        while number != NONE and not is_used[number]:
            is_used[number] = True
            line.append(number)
            number = after[number]
        if line:
            yield np.array(line)


def _lengths(after: list[int]) -> NDArray[np.int64]:
    """Number (n,) of places from each to the end of its line; a ring is cut where it closes."""
    lengths = [0] * len(after)
    for start in range(len(after)):
        way, number = [], start
        while number != NONE and not lengths[number]:
            lengths[number] = 1  # until the end of the way is known
            way.append(number)
            number = after[number]
        length = 0 if number == NONE else lengths[number]
        for passed in reversed(way):
            length += 1
            lengths[passed] = length
    return np.array(lengths, dtype=np.int64)

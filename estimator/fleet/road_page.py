"""Learned road on the page of a fleet: slope along the longest lines of places, with its sd."""

import numpy as np

from estimator.fleet.road import LearnedRoad
from estimator.fleet.road_lines import RoadLine, road_lines
from estimator.report.number_format import rounded
from estimator.report.page.plot import Axis, axis, band, line, plot
from estimator.report.page.tables import table
from estimator.road_map import CELL, COURSES, centre_of, place_of

MAX_LINES = 4  # that are drawn: both directions of two roads
MAX_ROWS = 20  # of the table
MIN_LENGTH = 1000.0  # m, of a line: shorter ones are crossings, and places beside a road
INTERVAL = 1.645  # sds on either side that hold 90 %
DIRECTIONS = ("north", "north-east", "east", "south-east", "south", "south-west", "west", "north-west")
assert len(DIRECTIONS) == COURSES


def road_figures(road: LearnedRoad) -> str:
    """Figures of the longest lines, and a table of their positions; a sentence if no place is known."""
    if not len(road.key):
        return (
            "<p>No road was learned: latitude and longitude are not on the bus, or a map is in the configuration.</p>"
        )
    lines = road_lines(road.key, road.passes)
    long = [line for line in lines if line.distance[-1] >= MIN_LENGTH]
    number, sure = len(road.key), len(road.map.key)
    passes = int(road.passes.sum())
    words = (
        f"{number:,} places of {CELL:.0f} m and a direction, from {passes:,} passes; "
        f"the slopes of {sure:,} are certain enough for the map of a gateway. "
    )
    if not long:
        return f"<p>{words}No {MIN_LENGTH / 1e3:.0f} km of places follow each other; they are in road.parquet.</p>"
    note = "Slope along the longest lines of places, in the direction of travel; the area is a 90 % interval."
    figures = "".join(_figure(road, line, i) for i, line in enumerate(long[:MAX_LINES], start=1))
    return f'<p>{words}</p><p class="soft">{note}</p>{figures}{_where(road, long, len(lines))}'


def _figure(road: LearnedRoad, along: RoadLine, number: int) -> str:
    at, slope, sd = along.distance / 1e3, 100 * road.slope[along.places], 100 * road.sd[along.places]
    low, high = slope - INTERVAL * sd, slope + INTERVAL * sd
    x = Axis(0.0, float(at[-1]), "distance [km]")
    y = axis([*low.tolist(), *high.tolist()], "slope [%]", zero=True, margin=0.05)
    words = f"Slope of line {number}, {at[-1]:.1f} km, from {slope.min():.1f} to {slope.max():.1f} %"
    shapes = band(x, y, at, low, high, "band after") + line(x, y, at, slope, "line after")
    title = f"line {number}: {at[-1]:.1f} km, at first to the {_direction(road, along)}"
    return plot(shapes, x, y, words, title=title)


def _direction(road: LearnedRoad, along: RoadLine) -> str:
    return DIRECTIONS[int(place_of(road.key[along.places[:1]])[2][0])]


def _where(road: LearnedRoad, lines: list[RoadLine], number: int) -> str:
    """Table of the beginnings and ends of lines, and of the sds of their slopes."""
    rows = []
    for i, along in enumerate(lines[:MAX_ROWS], start=1):
        row, column, _ = place_of(road.key[along.places[[0, -1]]])
        begin, end = np.degrees(np.column_stack(centre_of(row, column)))
        rows.append(
            (
                str(i),
                f"{begin[0]:.4f}, {begin[1]:.4f}",
                f"{end[0]:.4f}, {end[1]:.4f}",
                rounded(float(along.distance[-1]) / 1e3, 1),
                rounded(float(road.passes[along.places].mean()), 1),
                rounded(float(np.sqrt(np.mean((100 * road.slope[along.places]) ** 2))), 2),
                rounded(float(np.median(100 * road.sd[along.places])), 2),
            )
        )
    headings = ("line", "from, °", "to, °", "length [km]", "passes a place", "slopes, rms [%]", "usual sd [%]")
    left = number - len(rows)
    more = f'<p class="soft">{left:,} shorter lines are in road.parquet.</p>' if left else ""
    return f"<details><summary>Where the lines are</summary>{table(headings, rows, 'road')}{more}</details>"

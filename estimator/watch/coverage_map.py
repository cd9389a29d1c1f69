"""The coverage map in characters: speed to the right, acceleration upwards, a cell in one to three columns."""

import math
from typing import NamedTuple

from rich.text import Text

from estimator.answers.run import CoverageMap
from estimator.report.wanted_driving import BEGUN, EMPTY, OCCUPIED, WANTED, cell_states
from estimator.units import KMH

MIN_LINES = 5  # of cells, below which the map would not be readable
MAX_ACROSS = 3  # columns of a cell
LABEL = 6  # columns of an acceleration beside the map
STYLES = ("", "dim", "cyan", "cyan")


class Glyphs(NamedTuple):
    """Characters of the four states of a cell, and of a sparkline."""

    cells: str
    heights: str


BLOCKS = Glyphs(" ·▒█", "▁▂▃▄▅▆▇█")
ASCII = Glyphs(" .+#", "_.-=+*%#")


def plan(cells: CoverageMap, width: int, height: int, glyphs: Glyphs) -> list[Text]:
    """The coverage map: speed to the right, acceleration upwards; none where it would not be readable."""
    states = cell_states(cells)
    height -= 3  # axis, its unit, legend
    if not states or height < MIN_LINES:
        return []
    columns = max(i for i, _ in states) + 1
    bottom, top = min(j for _, j in states), max(j for _, j in states)
    across = max((n for n in range(1, MAX_ACROSS + 1) if n * columns + LABEL <= width), default=1)
    together = math.ceil((top - bottom + 1) / height)  # rows of cells in one line
    result = []
    for j in range(top, bottom - 1, -together):
        rows = range(max(j - together + 1, bottom), j + 1)
        middle = cells.lowest_acceleration_m_s2 + (sum(rows) / len(rows) + 0.5) * cells.acceleration_step_m_s2
        line = Text(f"{middle:+.2f}" if not (top - j) // together % 2 else "", "dim")
        line.pad_right(LABEL - line.cell_len)
        for i in range(columns):
            state = _together([states.get((i, row), EMPTY) for row in rows])
            line.append(glyphs.cells[state] * across, STYLES[state])
        result.append(line)
    result.append(_speed_axis(columns, across, KMH * cells.speed_step_m_s))
    key = (f"{glyphs.cells[OCCUPIED]} enough", f"{glyphs.cells[BEGUN]} begun", f"{glyphs.cells[WANTED]} wanted")
    return [Text("m/s²", "dim"), *result, Text(f"{'':{LABEL}}{'  '.join(key)}", "dim")]


def _together(states: list[int]) -> int:
    """The state of several cells in one place: occupied where none is wanting."""
    there = [state for state in states if state != EMPTY]
    if not there:
        return EMPTY
    return max(there) if min(there) == max(there) or WANTED not in there else BEGUN


def _speed_axis(columns: int, across: int, step: float) -> Text:
    """Speeds [km/h] below the map, as many as have room; ``step`` is the width of a cell."""
    room = 6  # columns of a label with its gap
    every = next(s for s in (10, 20, 30, 50, 100, 200, 1000) if s / step * across >= room)
    line = ""
    for speed in range(0, int(columns * step) + 1, every):
        line = f"{line:{round(speed / step * across)}}{speed}"
    return Text(f"{'':{LABEL}}{line} km/h", "dim")

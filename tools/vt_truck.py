"""Recordings and logs from the 1 Hz table of a class-8 truck (Wang and Rakha 2017).

The table joins recordings phase by phase, and rows are missing inside some: speed or elevation jumps there. Recordings
are cut at these jumps.
"""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from table import Table
from table_to_log import frames_of_table

from estimator.can_io.binding import load_database
from estimator.can_io.log_writer import write_log
from estimator.signals import Mask

DBC = Path(__file__).with_suffix(".dbc")
LOWER_HEATING_VALUE = 42.8  # kJ/g, of diesel
EFFICIENCY = 0.42  # of the truck's engine, assumed
SPEED, FUEL, ENGINE, ELEVATION = "vel (mph)", "fuel (g/s)", "engine (rpm)", "elevation (m)"
PHASE, TIME = "phase_num", "s"
MAP = [
    f"MOTION.Speed={SPEED}",
    f"ENGINE.Power={FUEL}*{LOWER_HEATING_VALUE * EFFICIENCY:.3f}",
    f"ENGINE.Speed={ENGINE}",
    f"ROAD.Elevation={ELEVATION}",
]
MAX_STEPS = {SPEED: 5.6, ELEVATION: 4.0}  # between two rows: 2.5 m/s^2; more than on the steepest road
MIN_ROWS = 30  # rows between jumps
PAUSE = 60.0  # s inserted at a jump, so that no signal is held across it


def recordings(table: Table) -> Iterator[tuple[str, Table]]:
    """Name, such as ``1b`` for the second of phase 1, and rows of each recording, with a column TIME [s]."""
    phase = np.array([int(float(cell)) for cell in table.column(PHASE)])
    seen: Counter[int] = Counter()
    for rows in _runs(np.diff(phase) != 0):
        number = int(phase[rows[0]])
        chosen = np.zeros(len(table), dtype=bool)
        chosen[rows] = True
        yield f"{number}{chr(ord('a') + seen[number])}", _cut(table[chosen])
        seen[number] += 1


def _cut(recording: Table) -> Table:
    """The recording without the rows near its jumps, with a pause in the place of each."""
    columns = {name: recording.numbers(name) for name in (SPEED, FUEL, ENGINE, ELEVATION)}
    jumps = np.any([np.abs(np.diff(columns[name])) > most for name, most in MAX_STEPS.items()], axis=0)
    pieces = [(i, rows) for i, rows in enumerate(_runs(jumps)) if len(rows) >= MIN_ROWS]
    chosen = np.concatenate([rows for _, rows in pieces]) if pieces else np.empty(0, np.int64)
    cells = {TIME: [float(row + PAUSE * i) for i, rows in pieces for row in rows.tolist()]}
    cells |= {name: values[chosen].tolist() for name, values in columns.items()}
    return Table(recording.path, [recording.line[row] for row in chosen.tolist()], cells)


def _runs(ends: Mask) -> list[NDArray[np.intp]]:
    """Stretches of the indices (n,); ``ends`` (n - 1,) is true after the last index of a stretch."""
    return np.split(np.arange(len(ends) + 1), np.flatnonzero(ends) + 1)


def write(recording: Table, log: Path) -> None:
    """The recording as CAN frames of DBC."""
    frames, _ = frames_of_table(recording, recording.numbers(TIME), load_database([str(DBC)]), MAP)
    write_log(frames, log)

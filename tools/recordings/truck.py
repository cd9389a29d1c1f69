"""Recordings from the 1 Hz table of a class-8 truck (Wang and Rakha 2017).

The table joins recordings phase by phase, and rows are missing inside some: speed or elevation jumps there. Recordings
are cut at these jumps.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.signals import Floats, Mask
from recordings import write_table

CONFIG = Path(__file__).with_suffix(".toml")
LOWER_HEATING_VALUE = 42.8  # kJ/g, of diesel
EFFICIENCY = 0.42  # of the truck's engine, assumed
MIN_POWER = 1.5  # kW; with less fuel the drag of the engine, which is not known, matters
SPEED, FUEL, ENGINE, ELEVATION, PHASE = "vel (mph)", "fuel (g/s)", "engine (rpm)", "elevation (m)", "phase_num"
MAX_STEPS = {SPEED: 5.6, ELEVATION: 4.0}  # between two rows: 2.5 m/s^2; more than on the steepest road
MIN_ROWS = 30  # rows between jumps
PAUSE = 60.0  # s inserted at a jump, so that no signal is held across it
Columns = Mapping[str, Floats]  # (n,) by name


def read(path: Path) -> Columns:
    """The columns of the table that are used."""
    rows = np.genfromtxt(path, delimiter=",", names=True, deletechars="", replace_space=" ")
    return {name: rows[name] for name in (SPEED, FUEL, ENGINE, ELEVATION, PHASE)}


def recordings(table: Columns) -> Iterator[tuple[str, Columns]]:
    """Name, such as ``1b`` for the second of phase 1, and columns of each recording, with times "t" [s]."""
    phase = table[PHASE].astype(int)
    seen: Counter[int] = Counter()
    for rows in _runs(np.diff(phase) != 0):
        number = int(phase[rows[0]])
        yield f"{number}{chr(ord('a') + seen[number])}", _cut({name: values[rows] for name, values in table.items()})
        seen[number] += 1


def _cut(recording: Columns) -> Columns:
    """The recording without the rows near its jumps, with a pause in the place of each."""
    jumps = np.any([np.abs(np.diff(recording[name])) > most for name, most in MAX_STEPS.items()], axis=0)
    pieces = [(i, rows) for i, rows in enumerate(_runs(jumps)) if len(rows) >= MIN_ROWS]
    chosen = np.concatenate([rows for _, rows in pieces]) if pieces else np.empty(0, np.int64)
    t = np.concatenate([rows + PAUSE * i for i, rows in pieces]) if pieces else np.empty(0)
    return {"t": t, **{name: values[chosen] for name, values in recording.items()}}


def _runs(ends: Mask) -> list[NDArray[np.intp]]:
    """Stretches of the indices (n,); ``ends`` (n - 1,) is true after the last index of a stretch."""
    return np.split(np.arange(len(ends) + 1), np.flatnonzero(ends) + 1)


def write(recording: Columns, table: Path) -> None:
    """Write a recording as the table that CONFIG reads."""
    power = recording[FUEL] * LOWER_HEATING_VALUE * EFFICIENCY
    columns = {
        "t": recording["t"],
        "speed": recording[SPEED],
        "power": np.where(power >= MIN_POWER, power, np.nan),
        "engine": recording[ENGINE],
        "elevation": recording[ELEVATION],
    }
    write_table(table, columns)

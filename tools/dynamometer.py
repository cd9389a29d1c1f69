"""Logs from recordings of cars on a chassis dynamometer (Argonne National Laboratory, D3), 10 Hz.

The rolls are driven with the road load and the inertia of the car on a road; the force there is measured. Losses of the
tyres on the rolls are outside of it, so A is about 0.
"""

from pathlib import Path

import numpy as np
from table import Table
from table_to_log import frames_of_table

from estimator.can_io.binding import load_database
from estimator.can_io.log_writer import write_log
from estimator.signals import Floats

DBC = Path(__file__).with_suffix(".dbc")
TIME, SPEED, POWER, BRAKE = "s", "mph", "kW", "brake"
MAP = [f"ROLLS.Speed={SPEED}", f"ROLLS.Power={POWER}", f"ROLLS.Brake={BRAKE}"]
MPH = 0.44704  # m/s
COLUMNS = (0, 4, 5)  # time [s], speed [mph] and force [N] of the rolls, in files with a header and without


def read(path: Path) -> tuple[Floats, Floats, Floats]:
    """Time [s], speed [mph] and force [N] (n,) of the rolls; the first row may be a header."""
    with path.open() as lines:
        header = next(lines).startswith("Time")
    rows = np.loadtxt(path, delimiter="\t", comments=None, usecols=COLUMNS, skiprows=int(header))
    t, speed, force = rows.T
    return t, speed, force


def write(path: Path, log: Path) -> None:
    """A recording as CAN frames of DBC."""
    t, speed, force = read(path)
    power = force * speed * MPH / 1e3
    cells = {SPEED: np.maximum(speed, 0.0).tolist(), POWER: power.tolist(), BRAKE: [0.0] * len(t)}
    table = Table(path, list(range(1, len(t) + 1)), cells)
    frames, _ = frames_of_table(table, t, load_database([str(DBC)]), MAP)
    write_log(frames, log)


def least_squares(path: Path) -> float:
    """Mass [kg] by least squares of the measured force on 1, v^2 and the acceleration, all moving samples."""
    t, speed, force = read(path)
    v = speed * MPH
    moving = v > 2.0
    columns = np.column_stack([np.ones(len(v)), v**2, np.gradient(v, t)])
    found = np.linalg.lstsq(columns[moving], force[moving], rcond=None)[0]
    return float(found[2])

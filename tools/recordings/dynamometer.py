"""Recordings of cars on a chassis dynamometer (Argonne National Laboratory, D3), 10 Hz.

The rolls are driven with the road load and the inertia of the car on a road; the force there is measured. Losses of the
tyres on the rolls are outside of it, so A is about 0.
"""

from pathlib import Path

import numpy as np

from estimator.signals import Floats
from recordings import write_table

CONFIG = Path(__file__).with_suffix(".toml")
MPH = 0.44704  # m/s
COLUMNS = (0, 4, 5)  # time [s], speed [mph] and force [N] of the rolls, in files with a header and without


def read(path: Path) -> tuple[Floats, Floats, Floats]:
    """Time [s], speed [mph] and force [N] (n,) of the rolls; the first row may be a header."""
    with path.open() as lines:
        header = next(lines).startswith("Time")
    rows = np.loadtxt(path, delimiter="\t", comments=None, usecols=COLUMNS, skiprows=int(header))
    t, speed, force = rows.T
    return t, speed, force


def write(path: Path, table: Path) -> None:
    """Write a recording as the table that CONFIG reads; the brake is never told."""
    t, speed, force = read(path)
    columns = {"t": t, "speed": np.maximum(speed, 0.0), "force": force, "brake": np.zeros(len(t))}
    write_table(table, columns)


def least_squares(path: Path) -> float:
    """Mass [kg] by least squares of the measured force on 1, v^2 and the acceleration, all moving samples."""
    t, speed, force = read(path)
    v = speed * MPH
    moving = v > 2.0
    columns = np.column_stack([np.ones(len(v)), v**2, np.gradient(v, t)])
    found = np.linalg.lstsq(columns[moving], force[moving], rcond=None)[0]
    return float(found[2])

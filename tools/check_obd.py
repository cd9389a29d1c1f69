"""Masses of simulated cars that a logger asks by OBD-II, by its period and by the road: bias and coverage.

    python tools/check_obd.py [--drives 20] [--slow 10] [--minutes 45] [--seed 1]

Speed comes in whole km/h and torque in whole per cent, each once in a period. The road is level or hilly, and no signal
shows it; the car of a drive is the same at all periods.
"""

import argparse
import sys
from itertools import product

import numpy as np
from harness.check import Cells, Check, Figures, Table, drive_options, percent, progress
from harness.drives import drive, estimates
from harness.scores import Score, summary
from msgspec.structs import replace

from estimator import config
from estimator.can_io.frames import Frames
from estimator.can_io.obd2_encoder import frames_of
from estimator.config import Config
from estimator.simulation.polling import polled
from estimator.simulation.recording import Recording
from estimator.simulation.truck import Truck, draw_car

PERIODS = {0.25: False, 0.5: False, 1.0: True, 2.0: True}  # s a PID, and whether there are fewer drives of it
ROADS = {"level": 0.0, "hilly": 0.012}  # sd of the slopes, rise over run
RARELY = 600.0  # s between estimates: the last one counts
NAMES = ("mass", "A", "C")
HOLDS = tuple(f"90 % intervals that hold {name}" for name in NAMES)


def driven(number: int, slopes: float, minutes: float, seed: int) -> Recording:
    """A drive of a car drawn at random."""
    rng = np.random.default_rng([seed, number])
    return drive(draw_car(rng), "mixed", minutes, rng, slopes)


def settings() -> Config:
    """The shipped configuration, with estimates that are far apart."""
    shipped = config.load("obd2")
    return config.replace(shipped, gate=replace(shipped.gate, interval_s=RARELY))


def estimated(truck: Truck, frames: Frames, chosen: Config) -> dict[str, Score]:
    """Scores of mass, A and C as last estimated."""
    last = estimates(frames, chosen)[-1]
    marginals = {name: getattr(last, name) for name in NAMES}
    return {name: Score.of(x, getattr(truck, name)) for name, x in marginals.items() if x is not None}


def measure(options: argparse.Namespace) -> Figures:
    """Figures of each road and period."""
    found: dict[tuple[str, float], list[dict[str, Score]]] = {cell: [] for cell in product(ROADS, PERIODS)}
    drives = list(product(ROADS, range(max(options.drives, options.slow))))
    for road, number in progress(drives, "driving"):
        recording = driven(number, ROADS[road], options.minutes, options.seed)
        for period, is_slow in PERIODS.items():
            if number < (options.slow if is_slow else options.drives):
                rng = np.random.default_rng([options.seed, number, round(1000 * period)])
                frames = frames_of(polled(recording.signals, period, rng))
                found[road, period].append(estimated(recording.truth.truck, frames, settings()))
    return {
        "cells": [
            {"road": road, "period_s": period, "drives": len(scores)}
            | {name: summary([score[name] for score in scores if name in score]) for name in NAMES}
            for (road, period), scores in found.items()
        ]
    }


def tables(figures: Figures) -> list[Table]:
    """A row for each road and period."""
    columns = ("road, s a PID", "estimated", "bias of the mass", "rms error", "sd", *HOLDS)
    rows = [
        [
            f"{cell['road']}, {cell['period_s']:g}",
            f"{cell['mass']['estimated']} of {cell['drives']}",
            *(percent(cell["mass"].get(key), sign="+") for key in ("bias", "rms", "sd")),
            *(f"{cell[name]['holds']} of {cell[name]['estimated']}" for name in NAMES),
        ]
        for cell in figures["cells"]
    ]
    return [Table("", columns, rows)]


def options(parser: argparse.ArgumentParser) -> None:
    """Number of drives at short and at long periods, their length and the seed."""
    drive_options(drives=20, minutes=45.0)(parser)
    parser.add_argument("--slow", type=int, default=10, help="drives of a road at long periods; default: %(default)s")


CHECK = Check(
    title="Cars by OBD-II",
    measure=measure,
    tables=tables,
    headline=Cells(rows=("level, 0.5", "hilly, 0.5"), columns=("estimated", "bias of the mass", *HOLDS)),
    options=options,
)

if __name__ == "__main__":
    sys.exit(CHECK.main())

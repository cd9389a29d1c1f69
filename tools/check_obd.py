"""Masses of simulated cars that a logger asks by OBD-II, by its period and by the road: bias and coverage.

    python tools/check_obd.py [--drives 20] [--slow 10] [--minutes 45] [--seed 1]

Speed comes in whole km/h and torque in whole per cent, each once in a period. The road is level or hilly, and no signal
shows it; the car of a drive is the same at all periods.
"""

import argparse
import sys
from itertools import product
from typing import Any

import numpy as np
from harness.check import Check, Figures, Table, drive_options, percent, progress
from harness.drives import METRES_PER_MINUTE
from harness.scores import rms
from msgspec.structs import replace

from estimator import config
from estimator.can_io.frames import Frames
from estimator.can_io.obd2_encoder import frames_of
from estimator.config import Config
from estimator.simulation.polling import polled
from estimator.simulation.recording import Recording, record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck, draw_car
from estimator.streaming.pipeline import Pipeline

PERIODS = {0.25: False, 0.5: False, 1.0: True, 2.0: True}  # s a PID, and whether there are fewer drives of it
ROADS = {"level": 0.0, "hilly": 0.012}  # sd of the slopes, rise over run
RARELY = 600.0  # s between estimates: the last one counts


def driven(number: int, slopes: float, minutes: float, seed: int) -> Recording:
    """A drive of a car drawn at random."""
    rng = np.random.default_rng([seed, number])
    car = draw_car(rng)
    return record(car, generate_route("mixed", minutes * METRES_PER_MINUTE, rng, slopes), 60.0 * minutes, rng)


def settings() -> Config:
    """The shipped configuration, with estimates that are far apart."""
    shipped = config.load("obd2")
    return config.replace(shipped, gate=replace(shipped.gate, interval_s=RARELY))


def estimated(truck: Truck, frames: Frames, chosen: Config) -> dict[str, Any]:
    """Relative error and sd of mass and A as last estimated, and whether the 90 % interval holds the truth."""
    pipeline = Pipeline(chosen)
    last = [*pipeline.feed(frames), *pipeline.finish()][-1]
    found = {}
    for name in ("mass", "A"):
        marginal, truth = getattr(last, name), getattr(truck, name)
        if marginal is not None:
            holds = marginal.q05 <= truth <= marginal.q95
            found[name] = {"error": marginal.mean / truth - 1, "sd": marginal.sd / truth, "holds": holds}
    return found


def summary(road: str, period: float, results: list[dict[str, Any]]) -> Figures:
    """Figures of the mass, errors as shares of the truth, and how many 90 % intervals hold mass and A."""
    masses = [result["mass"] for result in results if "mass" in result]
    error = [mass["error"] for mass in masses]
    return {
        "road": road,
        "period_s": period,
        "drives": len(results),
        "estimated": len(masses),
        "bias": float(np.mean(error)) if error else None,
        "rms": rms(error) if error else None,
        "sd": float(np.mean([mass["sd"] for mass in masses])) if masses else None,
        "holds": int(sum(mass["holds"] for mass in masses)),
        "A_holds": [sum(result["A"]["holds"] for result in results if "A" in result), sum("A" in r for r in results)],
    }


def measure(options: argparse.Namespace) -> Figures:
    """Figures of each road and period."""
    found: dict[tuple[str, float], list[dict[str, Any]]] = {cell: [] for cell in product(ROADS, PERIODS)}
    drives = list(product(ROADS, range(max(options.drives, options.slow))))
    for road, number in progress(drives, "driving"):
        recording = driven(number, ROADS[road], options.minutes, options.seed)
        for period, is_slow in PERIODS.items():
            if number < (options.slow if is_slow else options.drives):
                rng = np.random.default_rng([options.seed, number, round(1000 * period)])
                frames = frames_of(polled(recording.signals, period, rng))
                found[road, period].append(estimated(recording.truth.truck, frames, settings()))
    return {"cells": [summary(road, period, results) for (road, period), results in found.items()]}


def tables(figures: Figures) -> list[Table]:
    """A row for each road and period."""
    columns = ("road", "s a PID", "estimated", "mass: bias", "rms error", "sd", "90 % intervals hold", "A: hold")
    rows = [
        [
            cell["road"],
            f"{cell['period_s']:g}",
            f"{cell['estimated']} of {cell['drives']}",
            *(percent(cell[key], sign="+") for key in ("bias", "rms", "sd")),
            f"{cell['holds']} of {cell['estimated']}",
            "{} of {}".format(*cell["A_holds"]),
        ]
        for cell in figures["cells"]
    ]
    return [Table("", columns, rows)]


def options(parser: argparse.ArgumentParser) -> None:
    """Number of drives at short and at long periods, their length and the seed."""
    drive_options(drives=20, minutes=45.0)(parser)
    parser.add_argument("--slow", type=int, default=10, help="drives of a road at long periods; default: %(default)s")


CHECK = Check(name="obd", about=__doc__, measure=measure, tables=tables, options=options)

if __name__ == "__main__":
    sys.exit(CHECK.main())

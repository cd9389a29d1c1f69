"""Masses of simulated cars that a logger asks by OBD-II, by its period and by the road: bias and coverage.

python tools/check_obd.py [--drives 20] [--slow 10] [--minutes 45] [--seed 1] [--json]

Speed comes in whole km/h and torque in whole per cent, each once in a period. The road is level or hilly, and no signal
shows it; the car of a drive is the same at all periods.
"""

import argparse
import json
import sys
from typing import Any

import numpy as np
from harness.drives import METRES_PER_MINUTE
from msgspec.structs import replace
from rich.console import Console
from rich.table import Table

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


def summary(road: str, period: float, results: list[dict[str, Any]]) -> dict[str, Any]:
    """Figures of the mass: relative errors, and how many 90 % intervals hold it."""
    masses = [result["mass"] for result in results if "mass" in result]
    error = np.array([mass["error"] for mass in masses])
    return {
        "road": road,
        "period_s": period,
        "drives": len(results),
        "estimated": len(masses),
        "bias": float(error.mean()) if len(error) else None,
        "rms": float(np.sqrt(np.mean(error**2))) if len(error) else None,
        "sd": float(np.mean([mass["sd"] for mass in masses])) if masses else None,
        "holds": int(sum(mass["holds"] for mass in masses)),
        "A_holds": [sum(result["A"]["holds"] for result in results if "A" in result), sum("A" in r for r in results)],
    }


def table_of(rows: list[dict[str, Any]]) -> Table:
    """The figures as a table."""
    table = Table("road", "s a PID", "estimated", "mass: bias", "rms error", "sd", "90 % intervals hold", "A: hold")
    for row in rows:
        shares = ["" if row[key] is None else f"{100 * row[key]:+.1f} %" for key in ("bias", "rms", "sd")]
        counts = f"{row['estimated']} of {row['drives']}", f"{row['holds']} of {row['estimated']}"
        table.add_row(
            row["road"], f"{row['period_s']:g}", counts[0], *shares, counts[1], "{} of {}".format(*row["A_holds"])
        )
    return table


def main() -> int:
    """Drive, ask, estimate, and print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=20, help="of each road, at short periods")
    parser.add_argument("--slow", type=int, default=10, help="of each road, at long periods")
    parser.add_argument("--minutes", type=float, default=45.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    rows = []
    for road, slopes in ROADS.items():
        found: dict[float, list[dict[str, Any]]] = {period: [] for period in PERIODS}
        for number in range(max(options.drives, options.slow)):
            recording = driven(number, slopes, options.minutes, options.seed)
            for period, is_slow in PERIODS.items():
                if number < (options.slow if is_slow else options.drives):
                    rng = np.random.default_rng([options.seed, number, round(1000 * period)])
                    frames = frames_of(polled(recording.signals, period, rng))
                    found[period].append(estimated(recording.truth.truck, frames, settings()))
            rows_of_road = [summary(road, period, results) for period, results in found.items()]
            print(json.dumps(rows_of_road), file=sys.stderr)  # so far
        rows += rows_of_road
    if options.json:
        print(json.dumps(rows, indent=2))
    else:
        Console(width=None if sys.stdout.isatty() else 200).print(table_of(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Errors and interval coverage of estimates from simulated drives of different trucks, read through CAN bytes.

python tools/accuracy.py [--drives 20] [--minutes 60] [--route mixed] [--speed-noise 0.01] [--grade-sd 0.01]
    [--altimeter none] [--json]
"""

import argparse
import json
import sys
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from estimator.can_io.j1939_encoder import frames_of
from estimator.config import Config
from estimator.signals import Role
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.sensors import Sensors
from estimator.simulation.truck import draw_truck
from estimator.streaming.pipeline import Pipeline

NAMES = ("mass", "A", "C")
METRES_PER_MINUTE = 2000.0
OF_THE_ROAD = {Role.ALTITUDE, Role.GRADE, Role.LONGITUDINAL_ACCELERATION}  # signals that show slopes


def drive(seed: int, options: argparse.Namespace) -> dict[str, Any]:
    """Minutes to the first mass; relative error and sd of each estimated parameter, and whether its interval holds."""
    rng = np.random.default_rng(seed)
    truck = draw_truck(rng)
    route = generate_route(options.route, options.minutes * METRES_PER_MINUTE, rng, options.grade_sd)
    sensors = Sensors(
        speed_noise=options.speed_noise,
        torque_resolution=options.torque_resolution,
        altitude_noise=float(options.altimeter) if options.altimeter != "none" else 0.0,
        without=frozenset(OF_THE_ROAD - ({Role.ALTITUDE} if options.altimeter != "none" else set())),
    )
    pipeline = Pipeline(Config())
    frames = frames_of(record(truck, route, options.minutes * 60, rng, sensors=sensors).signals)
    updates = [*pipeline.feed(frames), *pipeline.finish()]
    first = next((update.t for update in updates if update.mass is not None), None)
    result: dict[str, Any] = {"first_min": None if first is None else (first - float(frames.t[0])) / 60}
    for name in NAMES:
        marginal, truth = getattr(updates[-1], name), getattr(truck, name)
        if marginal is not None:
            error, sd = marginal.mean / truth - 1, marginal.sd / truth
            result[name] = {"error": error, "sd": sd, "holds": marginal.q05 <= truth <= marginal.q95}
    return result


def main() -> int:
    """Print median and worst error, bias and coverage of the intervals."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=20)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--route", choices=["urban", "mixed", "highway"], default="mixed")
    parser.add_argument("--speed-noise", type=float, default=0.01, metavar="m/s")
    parser.add_argument("--torque-resolution", type=float, default=0.00125, metavar="FRACTION")
    parser.add_argument("--grade-sd", type=float, default=0.0, metavar="1", help="of the slopes, rise over run")
    parser.add_argument("--altimeter", default="none", metavar="m", help="sd of its error, or none: a hidden road")
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    console = Console(stderr=True)
    seeds = range(options.seed, options.seed + options.drives)
    results = [drive(seed, options) for seed in track(seeds, "driving", console=console, transient=True)]
    firsts = [result["first_min"] for result in results if result["first_min"] is not None]
    figures: dict[str, Any] = {"drives": len(results), "first_mass_min": float(np.median(firsts)) if firsts else None}
    table = Table("", "estimated", "median error", "worst", "bias", "mean sd", "90 % intervals that hold the truth")
    for name in NAMES:
        estimated = [result for result in results if name in result]
        if not estimated:
            continue
        error = np.array([r[name]["error"] for r in estimated])
        figures[name] = {
            "estimated": len(estimated),
            "within_2_percent": int((np.abs(error) < 0.02).sum()),
            "median": float(np.median(np.abs(error))),
            "worst": float(np.abs(error).max()),
            "bias": float(error.mean()),
            "sd": float(np.mean([r[name]["sd"] for r in estimated])),
            "holds": int(sum(r[name]["holds"] for r in estimated)),
        }
        shown = [f"{100 * figures[name][key]:.2f} %" for key in ("median", "worst", "bias", "sd")]
        table.add_row(
            name, f"{len(estimated)} of {len(results)}", *shown, f"{figures[name]['holds']} of {len(estimated)}"
        )
    if options.json:
        print(json.dumps(figures, indent=2))
    else:
        if firsts:
            print(f"first mass after {np.median(firsts):.1f} min (median), {max(firsts):.1f} min at the latest")
        Console().print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""How far off, and how honest: simulated drives of different trucks through CAN bytes, against their truth.

python tools/accuracy.py [--drives 20] [--minutes 60] [--route mixed] [--speed-noise 0.01] [--json]
"""

import argparse
import json
import sys
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from estimator.can_io.recorder import frames_of
from estimator.config import Config
from estimator.pipeline import Pipeline
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.sensors import Sensors
from estimator.simulation.truck import draw_truck

NAMES = ("mass", "A", "C")
METRES_PER_MINUTE = 2000.0


def drive(seed: int, options: argparse.Namespace) -> dict[str, Any] | None:
    """Relative error, relative sd and whether the 90 % interval holds the truth, for each parameter."""
    rng = np.random.default_rng(seed)
    truck = draw_truck(rng)
    route = generate_route(options.route, options.minutes * METRES_PER_MINUTE, rng)
    sensors = Sensors(speed_noise=options.speed_noise, torque_resolution=options.torque_resolution)
    pipeline = Pipeline(Config())
    updates = list(pipeline.feed(frames_of(record(truck, route, options.minutes * 60, rng, sensors=sensors).signals)))
    final = [*updates, *pipeline.finish()][-1]
    result = {}
    for name in NAMES:
        marginal, truth = getattr(final, name), getattr(truck, name)
        if marginal is None:
            return None
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
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    console = Console(stderr=True)
    seeds = range(options.seed, options.seed + options.drives)
    results = [drive(seed, options) for seed in track(seeds, "driving", console=console, transient=True)]
    estimated = [result for result in results if result is not None]
    figures: dict[str, Any] = {"drives": len(results), "estimated": len(estimated)}
    table = Table("", "median error", "worst", "bias", "mean sd", "90 % intervals that hold the truth")
    for name in NAMES if estimated else ():
        error = np.array([r[name]["error"] for r in estimated])
        figures[name] = {
            "median": float(np.median(np.abs(error))),
            "worst": float(np.abs(error).max()),
            "bias": float(error.mean()),
            "sd": float(np.mean([r[name]["sd"] for r in estimated])),
            "holds": int(sum(r[name]["holds"] for r in estimated)),
        }
        shown = [f"{100 * figures[name][key]:.2f} %" for key in ("median", "worst", "bias", "sd")]
        table.add_row(name, *shown, f"{figures[name]['holds']} of {len(estimated)}")
    if options.json:
        print(json.dumps(figures, indent=2))
    else:
        print(f"{len(estimated)} of {len(results)} drives estimated")
        Console().print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())

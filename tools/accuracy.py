"""Errors and interval coverage of estimates from simulated drives of different trucks, read through CAN bytes.

python tools/accuracy.py [--drives 20] [--minutes 60] [--route mixed] [--speed-noise 0.01] [--grade-sd 0.01]
    [--altimeter none] [--json]
python tools/accuracy.py --hills [--drives 162] [--first 0] [--minutes 40] [--seed 1] [--json]

With ``--hills`` every drive has a road of its own: kind of road, altimeter, noise of the speed and steps of the torque
take turns (54 drives are all combinations), slopes and lag are drawn; the figures are of each of these groups. They
are of the last estimate, so there is one every ten minutes only.
"""

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.config import Config, from_dict
from estimator.signals import Role
from estimator.simulation.recording import Recording, record
from estimator.simulation.route import RoadKind, generate_route
from estimator.simulation.sensors import Sensors
from estimator.simulation.truck import Truck, draw_truck
from estimator.streaming.pipeline import Pipeline

NAMES = ("mass", "A", "C")
METRES_PER_MINUTE = 2000.0
OF_THE_ROAD = {Role.ALTITUDE, Role.GRADE, Role.LONGITUDINAL_ACCELERATION}  # signals that show slopes
ALTIMETERS = {"hidden": None, "poor": 5.0, "good": 0.3}  # m, sd of the error, which changes over 30 s
KINDS: tuple[RoadKind, ...] = ("urban", "mixed", "highway")
SPEED_NOISES = (0.0, 0.01, 0.03)  # m/s
TORQUE_STEPS = (0.00125, 0.01)  # of the reference torque
SLOPES = (0.004, 0.016)  # sd, rise over run
LAGS = (0.0, 0.2)  # s, of torque behind speed
RARELY = {"gate": {"interval_s": 600.0}}
LIMITS = (0.02, 0.015, 0.005)  # errors of the mass below which drives are counted


@dataclass(frozen=True, kw_only=True)
class World:
    """Road and sensors of a drive: slopes by their sd [1], speed noise [m/s], torque steps [1], lag of torque [s].

    ``altimeter``: sd of its error [m]; None where no signal shows the road.
    """

    kind: RoadKind
    slopes: float
    altimeter: float | None
    speed_noise: float
    torque_steps: float
    lag: float

    def drive(self, minutes: float, rng: np.random.Generator) -> tuple[Truck, Frames]:
        """A truck drawn at random, and the frames of its drive of ``minutes`` [min]."""
        recording = self.recorded(minutes, rng)
        return recording.truth.truck, frames_of(recording.signals)

    def recorded(self, minutes: float, rng: np.random.Generator) -> Recording:
        """The drive of a truck drawn at random, of ``minutes`` [min]."""
        truck = draw_truck(rng)
        route = generate_route(self.kind, minutes * METRES_PER_MINUTE, rng, self.slopes)
        sensors = Sensors(
            speed_noise=self.speed_noise,
            torque_resolution=self.torque_steps,
            torque_lag=self.lag,
            altitude_noise=self.altimeter or 0.0,
            without=frozenset(OF_THE_ROAD - ({Role.ALTITUDE} if self.altimeter is not None else set())),
        )
        return record(truck, route, minutes * 60, rng, sensors=sensors)


def hills(number: int, rng: np.random.Generator) -> World:
    """The world of drive ``number`` of a set."""
    return World(
        kind=KINDS[number % 3],
        altimeter=list(ALTIMETERS.values())[number // 3 % 3],
        speed_noise=SPEED_NOISES[number // 9 % 3],
        torque_steps=TORQUE_STEPS[number // 27 % 2],
        slopes=float(rng.uniform(*SLOPES)),
        lag=float(rng.uniform(*LAGS)),
    )


def estimated(truck: Truck, frames: Frames, config: Config) -> dict[str, Any]:
    """Minutes to the first mass; relative error and sd of each estimated parameter, and whether its interval holds."""
    pipeline = Pipeline(config)
    updates = [*pipeline.feed(frames), *pipeline.finish()]
    first = next((update.t for update in updates if update.mass is not None), None)
    result: dict[str, Any] = {"first_min": None if first is None else (first - float(frames.t[0])) / 60}
    for name in NAMES:
        marginal, truth = getattr(updates[-1], name), getattr(truck, name)
        if marginal is not None:
            error, sd = marginal.mean / truth - 1, marginal.sd / truth
            result[name] = {"error": error, "sd": sd, "holds": marginal.q05 <= truth <= marginal.q95}
    return result


def figures_of(results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Errors and coverage of some drives, by parameter."""
    firsts = [result["first_min"] for result in results if result["first_min"] is not None]
    figures: dict[str, Any] = {"drives": len(results), "first_mass_min": float(np.median(firsts)) if firsts else None}
    for name in NAMES:
        found = [result[name] for result in results if name in result]
        if not found:
            continue
        error = np.array([x["error"] for x in found])
        figures[name] = {
            "estimated": len(found),
            **{f"within_{100 * limit:g}_percent": int((np.abs(error) < limit).sum()) for limit in LIMITS},
            "median": float(np.median(np.abs(error))),
            "rms": float(np.sqrt(np.mean(error**2))),
            "worst": float(np.abs(error).max()),
            "bias": float(error.mean()),
            "sd": float(np.mean([x["sd"] for x in found])),
            "holds": int(sum(x["holds"] for x in found)),
        }
    return figures


def groups(drives: Sequence[tuple[World, dict[str, Any]]]) -> Iterator[tuple[str, str, list[dict[str, Any]]]]:
    """What shows the road, a further property, and the drives that share both."""
    for shown, noise in ALTIMETERS.items():
        same = [(world, result) for world, result in drives if world.altimeter == noise]
        yield shown, "all", [result for _, result in same]
        for kind in KINDS:
            yield shown, kind, [result for world, result in same if world.kind == kind]
        for speed_noise in SPEED_NOISES:
            fitting = [result for world, result in same if world.speed_noise == speed_noise]
            yield shown, f"speed {1000 * speed_noise:g} mm/s", fitting
        for steps in TORQUE_STEPS:
            yield shown, f"torque {100 * steps:g} %", [result for world, result in same if world.torque_steps == steps]


def plain(options: argparse.Namespace) -> tuple[dict[str, Any], Table]:
    """Figures and table of drives in one world."""
    world = World(
        kind=options.route,
        slopes=options.grade_sd,
        altimeter=None if options.altimeter == "none" else float(options.altimeter),
        speed_noise=options.speed_noise,
        torque_steps=options.torque_resolution,
        lag=options.torque_lag,
    )
    seeds = track(range(options.seed, options.seed + options.drives), "driving", console=ERRORS, transient=True)
    results = [estimated(*world.drive(options.minutes, np.random.default_rng(seed)), Config()) for seed in seeds]
    figures = figures_of(results)
    table = Table("", "estimated", "median error", "worst", "bias", "mean sd", "90 % intervals that hold the truth")
    for name in NAMES:
        if name in figures:
            of = figures[name]
            shown = [f"{100 * of[key]:.2f} %" for key in ("median", "worst", "bias", "sd")]
            table.add_row(name, f"{of['estimated']} of {len(results)}", *shown, f"{of['holds']} of {of['estimated']}")
    return figures, table


def hilly(options: argparse.Namespace) -> tuple[dict[str, Any], Table]:
    """Figures and table of drives over hills, by group."""
    drives, config = [], from_dict(RARELY)
    numbers = range(options.first, options.first + options.drives)
    for number in track(numbers, "driving", console=ERRORS, transient=True):
        rng = np.random.default_rng([options.seed, number])
        world = hills(number, rng)
        drives.append((world, estimated(*world.drive(options.minutes, rng), config)))
    limits = [f"within {100 * limit:g} %" for limit in LIMITS]
    table = Table("road", "drives", "mass", *limits, "rms", "bias", "m holds", "A holds", "C holds")
    figures: dict[str, Any] = {"drives": [{"world": asdict(world), **result} for world, result in drives]}
    for shown, group, results in groups(drives):
        found = figures[f"{shown}, {group}"] = figures_of(results)
        if "mass" not in found:
            continue
        mass = found["mass"]
        counts = [str(mass[f"within_{100 * limit:g}_percent"]) for limit in LIMITS]
        holds = [f"{found[x]['holds']} of {found[x]['estimated']}" if x in found else "" for x in NAMES]
        errors = [f"{100 * mass['rms']:.2f} %", f"{100 * mass['bias']:+.2f} %"]
        table.add_row(f"{shown}, {group}", str(len(results)), str(mass["estimated"]), *counts, *errors, *holds)
    return figures, table


ERRORS = Console(stderr=True)


def main() -> int:
    """Print median and worst error, bias and coverage of the intervals."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hills", action="store_true", help="a road and sensors of its own for every drive")
    parser.add_argument("--drives", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="number of the first drive over hills")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--route", choices=["urban", "mixed", "highway"], default="mixed")
    parser.add_argument("--speed-noise", type=float, default=0.01, metavar="m/s")
    parser.add_argument("--torque-resolution", type=float, default=0.00125, metavar="FRACTION")
    parser.add_argument("--torque-lag", type=float, default=0.03, metavar="s")
    parser.add_argument("--grade-sd", type=float, default=0.0, metavar="1", help="of the slopes, rise over run")
    parser.add_argument("--altimeter", default="none", metavar="m", help="sd of its error, or none: a hidden road")
    parser.add_argument("--seed", type=int, default=1000)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    figures, table = hilly(options) if options.hills else plain(options)
    if options.json:
        print(json.dumps(figures, indent=2))
        return 0
    if not options.hills and figures["first_mass_min"] is not None:
        print(f"first mass after {figures['first_mass_min']:.1f} min (median)")
    Console(width=None if sys.stdout.isatty() else 200).print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())

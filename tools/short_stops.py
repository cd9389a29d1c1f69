"""The mass from stop to stop: a bus line on which passengers get on and off at stops of some 20 s.

    python tools/short_stops.py [--lines 10] [--stops 25] [--slopes 0.01] [--seed 1] [--json]

Every bus drives one line, with no signal of the road on the bus, `load.stop_s` of 15 s and an update every 10 s. The
newest mass before each stop is compared with the mass that the bus had on the way to it.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from accuracy import OF_THE_ROAD
from rich.console import Console
from rich.progress import track
from rich.table import Table

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.config import Config, from_dict
from estimator.estimates import Estimate, Marginal
from estimator.simulation.noise import smooth
from estimator.simulation.recording import record
from estimator.simulation.route import GRADE_SPACING, HILL_LENGTH, KMH, Route
from estimator.simulation.sensors import Sensors
from estimator.simulation.truck import Truck
from estimator.streaming.pipeline import Pipeline
from estimator.units import STANDARD_GRAVITY

SHORT_STOPS = {"load": {"stop_s": 15.0}, "gate": {"interval_s": 10.0}}
EMPTY, PASSENGER, SEATS = 12e3, 75.0, 80  # kg, kg, passengers
BOARDING = 15.0  # sd of the change in the number of passengers at a stop
ROLLING = 0.0055, 0.0075  # rolling coefficients [1]
DRAG = 3.0, 4.3  # N s^2/m^2
SPEEDS = 40, 50, 50, 60  # km/h
WAY = 260.0, 880.0  # m from stop to stop, shortest and longest
STANDING = 8.0, 14.0  # s at the end of a way, to which 5 to 15 s at the start of the next are added
LONGEST = 240.0  # s of a way: more than any takes
GROUPS = (0, 5), (5, 10), (10, None)  # ways that are put together: the first, and the one after the last


@dataclass(frozen=True)
class Way:
    """From one stop to the next: times of moving off and of the next departure [s], and the ``mass`` [kg]."""

    start: float
    end: float
    mass: float


def line(stops: int, slopes: float, rng: np.random.Generator) -> tuple[Frames, list[Way]]:
    """Frames of a bus on a line with slopes of a standard deviation [1], and its ways."""
    rolling, people = rng.uniform(*ROLLING), rng.uniform(0, SEATS)
    bus = Truck(mass=EMPTY, A=1.0, C=rng.uniform(*DRAG), reference_torque=2100.0, peak_torque=1900.0, rated_power=280e3)
    lengths = rng.integers(int(WAY[0] / GRADE_SPACING), int(WAY[1] / GRADE_SPACING), stops)
    ground = smooth(int(lengths.sum()) + 2, slopes, HILL_LENGTH / GRADE_SPACING / 2, rng)
    parts, ways, at, place = list[Frames](), list[Way](), 0.0, 0
    for length in lengths.tolist():
        people = float(np.clip(people + rng.normal(0.0, BOARDING), 0, SEATS))
        mass = EMPTY + PASSENGER * people
        road = Route(
            section_start=np.array([0.0]),
            section_speed=np.array([float(rng.choice(SPEEDS)) * KMH]),
            stop_position=np.array([GRADE_SPACING * length]),
            stop_dwell=np.array([np.inf]),
            grade=ground[place : place + length + 2],
        )
        loaded = replace(bus, mass=mass, A=rolling * STANDARD_GRAVITY * mass)
        way = record(loaded, road, LONGEST, rng, sensors=Sensors(without=frozenset(OF_THE_ROAD)))
        moving = way.truth.t[way.truth.v > 0]
        until = float(moving[-1] + rng.uniform(*STANDING))
        frames = frames_of(way.signals)
        frames = frames[frames.t < frames.t[0] + until]
        parts.append(replace(frames, t=frames.t + at))
        ways.append(Way(at + float(moving[0]), at + until, mass))
        at, place = at + until, place + length
    whole = Frames.concatenate(parts)
    return whole, [replace(way, start=way.start + whole.t[0], end=way.end + whole.t[0]) for way in ways]


def masses(frames: Frames, ways: Sequence[Way], config: Config) -> list[Marginal | None]:
    """The newest mass before the end of each way; None where none was known on it."""
    pipeline = Pipeline(config)
    updates: list[Estimate] = [*pipeline.feed(frames), *pipeline.finish()]
    return [
        next((x.mass for x in reversed(updates) if way.start < x.t < way.end and x.mass is not None), None)
        for way in ways
    ]


def figures_of(found: Sequence[tuple[float, float, bool] | None]) -> dict[str, Any]:
    """Figures of ways, from the relative error of each mass, half the width of its interval, and whether it holds."""
    known = [x for x in found if x is not None]
    error, width = np.array([x[0] for x in known]), np.array([x[1] for x in known])
    return {
        "ways": len(found),
        "mass": len(known),
        "rms": float(np.sqrt(np.mean(error**2))) if known else None,
        "worst": float(np.abs(error).max()) if known else None,
        "bias": float(error.mean()) if known else None,
        "half_width": float(np.median(width)) if known else None,
        "holds": sum(x[2] for x in known),
    }


def main() -> int:
    """Print errors and coverage by how many stops were before."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--lines", type=int, default=10)
    parser.add_argument("--stops", type=int, default=25)
    parser.add_argument("--slopes", type=float, default=0.01, metavar="1", help="sd, rise over run")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    config, lines = from_dict(SHORT_STOPS), []
    for number in track(range(options.lines), "driving", console=Console(stderr=True), transient=True):
        frames, ways = line(options.stops, options.slopes, np.random.default_rng([options.seed, number]))
        lines.append(
            [
                None if x is None else (x.mean / w.mass - 1, (x.q95 - x.q05) / 2 / x.mean, x.q05 <= w.mass <= x.q95)
                for x, w in zip(masses(frames, ways, config), ways, strict=True)
            ]
        )
    figures = {
        f"from stop {first + 1} on": figures_of([x for found in lines for x in found[first:end]])
        for first, end in GROUPS
    }
    if options.json:
        print(json.dumps(figures, indent=2))
        return 0
    table = Table("way", "with a mass", "rms error", "worst", "bias", "half of the interval", "interval holds")
    for name, x in figures.items():
        shown = [f"{100 * x[key]:.1f} %" for key in ("rms", "worst", "bias", "half_width")] if x["mass"] else [""] * 4
        table.add_row(name, f"{x['mass']} of {x['ways']}", *shown, f"{x['holds']} of {x['mass']}")
    Console(width=None if sys.stdout.isatty() else 160).print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())

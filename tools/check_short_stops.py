"""The mass from stop to stop: a bus line on which passengers get on and off at stops of some 20 s.

    python tools/check_short_stops.py [--lines 10] [--stops 25] [--slopes 0.01] [--seed 1]

Every bus drives one line, with no signal of the road on the bus, `load.stop_s` of 15 s and an update every 10 s. The
newest mass before each stop is compared with the mass that the bus had on the way to it.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from harness.check import Cells, Check, Figures, Table, percent, progress
from harness.drives import estimates, showing, traffic
from harness.scores import Score, summary

from estimator.can_io.frames import Frames
from estimator.config import Config, from_dict
from estimator.estimates import Marginal
from estimator.simulation.noise import smooth
from estimator.simulation.recording import record
from estimator.simulation.route import GRADE_SPACING, HILL_LENGTH, KMH, Route
from estimator.simulation.truck import Truck
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
        bus = replace(bus, mass=mass, A=rolling * STANDARD_GRAVITY * mass)
        way = record(bus, road, LONGEST, rng, sensors=showing())
        moving = way.truth.t[way.truth.v > 0]
        until = float(moving[-1] + rng.uniform(*STANDING))
        frames = traffic(way)
        frames = frames[frames.t < frames.t[0] + until]
        parts.append(replace(frames, t=frames.t + at))
        ways.append(Way(at + float(moving[0]), at + until, mass))
        at, place = at + until, place + length
    whole = Frames.concatenate(parts)
    return whole, [replace(way, start=way.start + whole.t[0], end=way.end + whole.t[0]) for way in ways]


def masses(frames: Frames, ways: Sequence[Way], config: Config) -> list[Marginal | None]:
    """The newest mass before the end of each way; None where none was known on it."""
    updates = estimates(frames, config)
    return [
        next((x.mass for x in reversed(updates) if way.start < x.t < way.end and x.mass is not None), None)
        for way in ways
    ]


def measure(options: argparse.Namespace) -> Figures:
    """Errors and coverage by how many stops were before."""
    config, lines = from_dict(SHORT_STOPS), []
    for number in progress(range(options.lines), "driving"):
        frames, ways = line(options.stops, options.slopes, np.random.default_rng([options.seed, number]))
        found = zip(masses(frames, ways, config), ways, strict=True)
        lines.append([None if mass is None else Score.of(mass, way.mass) for mass, way in found])
    figures = {}
    for first, end in GROUPS:
        scores = [score for found in lines for score in found[first:end]]
        known = [score for score in scores if score is not None]
        figures[f"from stop {first + 1} on"] = {"ways": len(scores), **summary(known)}
    return figures


def tables(figures: Figures) -> list[Table]:
    """A row for each group of ways."""
    columns = ("way", "with a mass", "rms error", "worst", "bias", "half of the interval", "interval holds")
    rows = [
        [
            name,
            f"{x['estimated']} of {x['ways']}",
            *(percent(x.get(key)) for key in ("rms", "worst", "bias", "half_width")),
            f"{x['holds']} of {x['estimated']}",
        ]
        for name, x in figures.items()
    ]
    return [Table("", columns, rows)]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the lines."""
    parser.add_argument("--lines", type=int, default=10)
    parser.add_argument("--stops", type=int, default=25)
    parser.add_argument("--slopes", type=float, default=0.01, metavar="1", help="sd, rise over run")
    parser.add_argument("--seed", type=int, default=1)


CHECK = Check(
    title="The mass from stop to stop",
    measure=measure,
    tables=tables,
    headline=Cells(columns=("with a mass", "rms error", "interval holds")),
    options=add_options,
)

if __name__ == "__main__":
    sys.exit(CHECK.main())

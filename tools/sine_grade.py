"""A truck with two loads over roads whose grade is a sine: its mass, the slopes found, and the share of the road.

python tools/sine_grade.py [--minutes 40] [--seed 1] [--json]

Both loads, all of AMPLITUDES and LENGTHS, the road hidden and shown by an altimeter of 0.3 m: 24 drives. The model has
a random road, whose slopes are forgotten over a length; a sine repeats for ever. "left if known" is the residual
that `roadload diagnose` promises for a known road, where the plain road load leaves "before".
"""

import argparse
import json
import sys
import tempfile
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from accuracy import METRES_PER_MINUTE
from natural_world import fitted, true_shares
from rich.console import Console
from rich.progress import track
from rich.table import Table

from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.components.budget import ROAD
from estimator.config import Config
from estimator.signals import Role
from estimator.simulation.recording import Recording, record
from estimator.simulation.route import GRADE_SPACING, generate_route
from estimator.simulation.sensors import Sensors
from estimator.simulation.truck import draw_truck
from estimator.streaming.drive_extraction import diagnose_logs, drives_of
from estimator.streaming.pipeline import Pipeline

LOADS = (18e3, 36e3)  # kg, of the whole truck
AMPLITUDES = (0.01, 0.02, 0.03)  # rise over run
LENGTHS = (500.0, 2000.0)  # m, of a period
ALTIMETERS = {"hidden": None, "shown": 0.3}  # m


@dataclass(frozen=True, kw_only=True)
class World:
    """Mass [kg], amplitude of the grade [1], its period [m], and whether a signal shows it."""

    mass: float
    amplitude: float
    length: float
    shown: str

    def drive(self, minutes: float, rng: np.random.Generator) -> Recording:
        """A drive of ``minutes`` [min] by a truck drawn at random, but for its mass."""
        drawn = draw_truck(rng)
        truck = replace(drawn, mass=self.mass, A=drawn.A * self.mass / drawn.mass)
        level = generate_route("mixed", minutes * METRES_PER_MINUTE, rng)
        phase = 2 * np.pi * (GRADE_SPACING * np.arange(len(level.grade)) / self.length + rng.random())
        route = replace(level, grade=self.amplitude * np.sin(phase))
        noise = ALTIMETERS[self.shown]
        without = {Role.GRADE, Role.LONGITUDINAL_ACCELERATION} | (set() if noise else {Role.ALTITUDE})
        sensors = Sensors(altitude_noise=noise or 0.0, without=frozenset(without))
        return record(truck, route, 60 * minutes, rng, sensors=sensors)


def score(world: World, recording: Recording, folder: Path) -> dict[str, Any]:
    """Estimate and diagnose a drive from its log in ``folder``, and compare with the truth."""
    log, config = folder / "drive.blf", Config()
    frames = frames_of(recording.signals)
    write_log(frames, log)
    pipeline = Pipeline(config)
    last = [*pipeline.feed(frames), *pipeline.finish()][-1]
    diagnosis, driven = diagnose_logs([log], config), drives_of(log, config)[0]
    part = None if diagnosis.budget is None else diagnosis.budget.part(ROAD)
    found = last.mass
    return {
        **asdict(world),
        "error": None if found is None else found.mean / world.mass - 1,
        "sd": None if found is None else found.sd / world.mass,
        "holds": found is not None and found.q05 <= world.mass <= found.q95,
        "reason": last.reason,
        "amplitude_found": None if last.road is None else float(np.sqrt(2)) * last.road.slope_sd,
        "named": [effect.name for effect in diagnosis.effects],
        "share": true_shares(recording, fitted(driven), driven.start)[ROAD],
        "found": None if part is None else [part.share, part.q05, part.q95],
        "before_kW": None if diagnosis.budget is None else diagnosis.budget.base / 1e3,
        "known_kW": None if part is None else part.expected / 1e3,
    }


def row(found: dict[str, Any]) -> list[str]:
    """A drive as cells of the table."""
    share = found["found"]
    return [
        f"{found['mass'] / 1e3:g}",
        f"{100 * found['amplitude']:g} %, {found['length']:g} m",
        found["shown"],
        found["reason"] if found["error"] is None else f"{100 * found['error']:+.2f} +- {100 * found['sd']:.2f} %",
        "yes" if found["holds"] else "no",
        "" if found["amplitude_found"] is None else f"{100 * found['amplitude_found']:.2f} %",
        " + ".join(found["named"]),
        f"{found['share']:.3f}",
        "" if share is None else "{:.3f} ({:.3f} .. {:.3f})".format(*share),
        "" if share is None else f"{found['before_kW']:.1f}, {found['known_kW']:.1f}",
    ]


def main() -> int:
    """Print a row for each drive."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=40.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    worlds = [
        World(mass=mass, amplitude=amplitude, length=length, shown=shown)
        for mass, amplitude, length, shown in product(LOADS, AMPLITUDES, LENGTHS, ALTIMETERS)
    ]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for k, world in enumerate(track(worlds, "driving", console=Console(stderr=True), transient=True)):
            rng = np.random.default_rng(options.seed + k)
            rows.append(score(world, world.drive(options.minutes, rng), Path(folder)))
    if options.json:
        print(json.dumps(rows, indent=2))
        return 0
    table = Table(
        "t", "grade", "road", "mass", "holds", "amplitude", "named", "road's share", "found", "kW before, left if known"
    )
    for found in rows:
        table.add_row(*row(found))
    Console(width=None if sys.stdout.isatty() else 200).print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""A truck with two loads over roads whose grade is a sine: its mass, the slopes found, and the share of the road.

    python tools/check_sine_grade.py [--drives 24] [--minutes 40] [--seed 1]

Both loads, all of AMPLITUDES and LENGTHS, the road hidden and shown by an altimeter of 0.3 m: 24 drives, or the first.
The model has a random road, whose slopes are forgotten over a length; a sine repeats for ever. "left if known" is the
residual that `roadload diagnose` promises for a known road, where the plain road load leaves "before".
"""

import argparse
import sys
import tempfile
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from check_budget import fitted, true_shares
from harness.check import Cells, Check, Figures, Table, drive_options, percent, progress
from harness.drives import METRES_PER_MINUTE, diagnosed, estimates, loaded, showing, traffic
from harness.scores import Score, rms

from estimator.components.budget import ROAD
from estimator.config import Config
from estimator.simulation.recording import Recording, record
from estimator.simulation.route import GRADE_SPACING, generate_route
from estimator.simulation.truck import draw_truck

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
        truck = loaded(draw_truck(rng), self.mass)
        level = generate_route("mixed", minutes * METRES_PER_MINUTE, rng)
        phase = 2 * np.pi * (GRADE_SPACING * np.arange(len(level.grade)) / self.length + rng.random())
        route = replace(level, grade=self.amplitude * np.sin(phase))
        return record(truck, route, 60 * minutes, rng, sensors=showing(ALTIMETERS[self.shown]))


def score(world: World, recording: Recording, folder: Path) -> dict[str, Any]:
    """Estimate and diagnose a drive from its log in ``folder``, and compare with the truth."""
    frames = traffic(recording)
    last = estimates(frames, Config())[-1]
    diagnosis, driven = diagnosed(frames, folder)
    part = None if diagnosis.budget is None else diagnosis.budget.part(ROAD)
    mass = None if last.mass is None else Score.of(last.mass, world.mass)
    return {
        **asdict(world),
        "error": None if mass is None else mass.error,
        "sd": None if mass is None else mass.sd,
        "holds": mass is not None and mass.holds,
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
        percent(found["amplitude_found"], 2),
        " + ".join(found["named"]),
        f"{found['share']:.3f}",
        "" if share is None else "{:.3f} ({:.3f} .. {:.3f})".format(*share),
        "" if share is None else f"{found['before_kW']:.1f}, {found['known_kW']:.1f}",
    ]


def measure(options: argparse.Namespace) -> Figures:
    """Every drive."""
    worlds = [
        World(mass=mass, amplitude=amplitude, length=length, shown=shown)
        for mass, amplitude, length, shown in product(LOADS, AMPLITUDES, LENGTHS, ALTIMETERS)
    ]
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for k, world in enumerate(progress(worlds[: options.drives], "driving")):
            rng = np.random.default_rng(options.seed + k)
            rows.append(score(world, world.drive(options.minutes, rng), Path(folder)))
    return {"drives": rows}


def tables(figures: Figures) -> list[Table]:
    """A row for each drive."""
    columns = ("t", "grade", "road", "mass", "holds", "amplitude", "named", "road's share", "found", "kW before, left")
    known = [found for found in figures["drives"] if found["error"] is not None]
    error, holds = percent(rms([found["error"] for found in known])), sum(found["holds"] for found in known)
    masses = {
        "": "all",
        "drives": len(figures["drives"]),
        "masses": len(known),
        "rms error": error,
        "intervals that hold": holds,
    }
    return [Table.of("", [masses]), Table("Drives", columns, [row(found) for found in figures["drives"]])]


CHECK = Check(
    title="Roads whose grade is a sine",
    measure=measure,
    tables=tables,
    headline=Cells(),
    options=drive_options(drives=24, minutes=40.0),
)

if __name__ == "__main__":
    sys.exit(CHECK.main())

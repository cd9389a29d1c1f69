"""A synthetic fleet through `roadload fleet`: whether its intervals hold the truth and its outliers are found.

    python tools/check_fleet.py OUT [--vehicles 8] [--drives 3] [--minutes 10] [--seed 1] [--workers 1]

Every vehicle drives several times (its C differs between drives, as wind and weather make it). The command reads the
logs in OUT, and its tables are compared with the truth.
"""

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
from harness.check import Cells, Check, Figures, Table, drive_options
from harness.drives import roadload
from harness.scores import Score, summary

from estimator.answers.fleet import FleetAnswer
from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.simulation.recording import simulate
from estimator.simulation.truck import Truck

DAY = 86_400.0  # s
ROLLING, DRAG = 0.062, 3.7  # of the type: A/m [N/kg], C [N s^2/m^2]
BETWEEN_VEHICLES = 0.03  # relative sd of both
BETWEEN_DRIVES = 0.04  # relative sd of both
LOADS = (14_000.0, 36_000.0)  # kg
OUTLIERS = {"truck-02": (1.0, 1.3), "truck-05": (1.35, 1.0)}  # factors of A/m and C: no fairings, brakes that drag


@dataclass(frozen=True)
class Made:
    """True A/m and C of the vehicles, and masses of the drives by their log."""

    vehicles: dict[str, tuple[float, float]]
    masses: dict[str, float]


def make(folder: Path, vehicles: int, drives: int, minutes: float, seed: int) -> Made:
    """Drive the fleet and write its logs, a folder a vehicle."""
    rng = np.random.default_rng(seed)
    truth, masses = {}, {}
    for v in range(1, vehicles + 1):
        name = f"truck-{v:02d}"
        factors = np.array(OUTLIERS.get(name, (1.0, 1.0))) * (1 + BETWEEN_VEHICLES * rng.standard_normal(2))
        truth[name] = (ROLLING * float(factors[0]), DRAG * float(factors[1]))
        (folder / name).mkdir(parents=True, exist_ok=True)
        for day in range(drives):
            rolling, drag = np.array(truth[name]) * (1 + BETWEEN_DRIVES * rng.standard_normal(2))
            mass = float(rng.uniform(*LOADS))
            path = folder / name / f"{day:02d}.blf"
            masses[str(path)] = mass
            own = rng.spawn(1)[0]
            if not path.exists():
                truck = Truck(mass=mass, A=rolling * mass, C=drag)
                frames = frames_of(simulate(truck, "highway", 60 * minutes, own).signals)
                at = DAY * day
                write_log(Frames(frames.t + at, frames.ident, frames.length, frames.data), path)
    return Made(truth, masses)


def compared(rows: list[dict[str, Any]], name: str, truth: list[float]) -> Figures:
    """Errors of a column of a table, and how many of its 90 % intervals hold the truth (n,)."""
    known = [(row, t) for row, t in zip(rows, truth, strict=True) if row[f"{name}_mean"] is not None]
    scores = [
        Score(
            row[f"{name}_mean"] / t - 1,
            row[f"{name}_sd"] / t,
            row[f"{name}_q05"] <= t <= row[f"{name}_q95"],
            (row[f"{name}_q95"] - row[f"{name}_q05"]) / 2 / row[f"{name}_mean"],
        )
        for row, t in known
    ]
    return {"of": len(rows), **summary(scores)}


def measure(options: argparse.Namespace) -> Figures:
    """Make the fleet, estimate it, and compare the estimates with the truth."""
    logs, out = options.folder / "logs", options.folder / f"fleet-{options.workers}"
    made = make(logs, options.vehicles, options.drives, options.minutes, options.seed)
    answer = roadload(FleetAnswer, "fleet", logs, "--workers", str(options.workers), "-o", out)
    drives = [row for row in pq.read_table(out / "drives.parquet").to_pylist() if row["source"] in made.masses]
    vehicles = pq.read_table(out / "vehicles.parquet").to_pylist()
    masses = [made.masses[row["source"]] for row in drives]
    truth = [made.vehicles[row["vehicle"]] for row in vehicles]
    return {
        "compared": {
            "mass by the drive": compared(drives, "mass_kg", masses),
            "mass, all drives": compared(drives, "joint_mass_kg", masses),
            "A/m": compared(vehicles, "A_per_mass_N_kg", [rolling for rolling, _ in truth]),
            "C": compared(vehicles, "C_N_s2_m2", [drag for _, drag in truth]),
        },
        "outliers_made": sorted(name for name in OUTLIERS if name in made.vehicles),
        "outliers_found": sorted(answer.outliers),
    }


def tables(figures: Figures) -> list[Table]:
    """A row for each parameter, and the outliers."""
    rows = [
        {
            "": name,
            "estimated": f"{x['estimated']} of {x['of']}",
            "rms error [%]": 100 * x["rms"],
            "mean sd [%]": 100 * x["sd"],
            "interval holds": f"{x['holds']} of {x['estimated']}",
        }
        for name, x in figures["compared"].items()
        if x["estimated"]
    ]
    outliers = [{name: ", ".join(figures[f"outliers_{name}"]) for name in ("made", "found")}]
    return [Table.of("", rows), Table.of("Outliers", outliers)]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the fleet."""
    parser.add_argument("folder", type=Path, metavar="OUT")
    parser.add_argument("--vehicles", type=int, default=8)
    drive_options(drives=3, minutes=10.0)(parser)
    parser.add_argument("--workers", type=int, default=1)


CHECK = Check(
    title="A fleet of logs",
    first="out/fleet",
    measure=measure,
    tables=tables,
    headline=Cells(columns=("interval holds",)),
    options=add_options,
)

if __name__ == "__main__":
    sys.exit(CHECK.main())

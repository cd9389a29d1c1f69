#!/usr/bin/env python3
"""A synthetic fleet through `roadload fleet`: whether its intervals hold the truth and its outliers are found.

``python3 tools/fleet_truth.py OUT`` drives every vehicle several times (its C differs between drives, as wind and
weather make it), writes the logs, runs the command and compares its tables with the truth. The page docs/fleet.md
prints the figures.
"""

import argparse
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from resource import RUSAGE_CHILDREN, getrusage

import numpy as np
import pyarrow.parquet as pq

from estimator.answers.answer import decode
from estimator.answers.fleet import FleetAnswer
from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.can_io.logs import open_log
from estimator.config import Config
from estimator.fleet.cache import Cache
from estimator.fleet.engine import Serial
from estimator.fleet.output import CACHE
from estimator.fleet.run import conclude, run_fleet
from estimator.fleet.sources import find_logs
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


def timed(command: list[str]) -> tuple[FleetAnswer, float, float]:
    """The answer of `roadload fleet`, its time by the clock [s], and its processor time [s]."""
    began, before = time.perf_counter(), getrusage(RUSAGE_CHILDREN)
    answer = subprocess.run(command, capture_output=True, text=True, check=True)
    after = getrusage(RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return decode(answer.stdout, FleetAnswer), time.perf_counter() - began, used


def print_costs(logs: Path, out: Path) -> None:
    """Frames and bytes of the logs, the largest process so far, and the processor time of all joint fits."""
    paths = sorted(logs.rglob("*.blf"))
    frames, size = sum(len(f) for path in paths for f in open_log(path)), sum(path.stat().st_size for path in paths)
    print(f"{len(paths)} logs, {frames:,} frames, {size / 2**20:,.0f} MiB")
    print(f"largest process: {getrusage(RUSAGE_CHILDREN).ru_maxrss / 1024:.0f} MiB")
    config = Config()
    found = run_fleet(find_logs([str(logs)]), config, Serial(), cache=Cache.of(out / CACHE, config, False))
    began = time.process_time()
    conclude(found.grouped, found.results, config, Serial())
    print(f"joint fits and comparison: {time.process_time() - began:.2f} s of processor time")


def inside(rows: list[dict[str, float]], name: str, truth: list[float]) -> str:
    """How many of the 90 % intervals hold the truth, and the relative errors."""
    known = [(row, t) for row, t in zip(rows, truth, strict=True) if row[f"{name}_mean"] is not None]
    hits = sum(row[f"{name}_q05"] <= t <= row[f"{name}_q95"] for row, t in known)
    error = np.array([row[f"{name}_mean"] / t - 1 for row, t in known])
    sd = np.array([row[f"{name}_sd"] / t for row, t in known])
    rms, stated = 100 * np.sqrt(np.mean(error**2)), 100 * np.sqrt(np.mean(sd**2))
    share = f"{len(known)} of {len(rows)} estimated, {hits} intervals hold the truth"
    return f"{share}, rms error {rms:.1f} %, sd {stated:.1f} %"


def main() -> int:
    """Make the fleet, estimate it twice (new and cached), and compare the estimates with the truth."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--vehicles", type=int, default=8)
    parser.add_argument("--drives", type=int, default=3)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    logs, out = options.out / "logs", options.out / f"fleet-{options.workers}"
    made = make(logs, options.vehicles, options.drives, options.minutes, options.seed)
    command = [sys.executable, "-m", "estimator", "fleet", str(logs), "-o", str(out), "--json"]
    for label in ("new", "cached"):
        answer, wall, used = timed([*command, "--workers", str(options.workers)])
        print(f"{label}: {wall:.1f} s by the clock, {used:.1f} s of processor time; rows {answer.rows}")
    drives = [row for row in pq.read_table(out / "drives.parquet").to_pylist() if row["source"] in made.masses]
    vehicles = pq.read_table(out / "vehicles.parquet").to_pylist()
    masses = [made.masses[row["source"]] for row in drives]
    print("mass by the drive:", inside(drives, "mass_kg", masses))
    print("mass, all drives: ", inside(drives, "joint_mass_kg", masses))
    for i, name in enumerate(("A_per_mass_N_kg", "C_N_s2_m2")):
        print(f"{name}:", inside(vehicles, name, [made.vehicles[row["vehicle"]][i] for row in vehicles]))
    print("outliers made: ", sorted(OUTLIERS), "found:", answer.outliers)
    print_costs(logs, out)
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""Class-8 drives simulated independently by NREL's fastsim, as J1939 logs with their truth.

    python tools/check_fastsim.py [--route long-haul --route vail] [--grade shown|withheld|both] [--folder FOLDER]

fastsim computes the power at the engine from speed and grade, step by step at 10 Hz: rolling resistance, drag, climb,
inertia of vehicle and wheels, the loss of its drivetrain and a constant auxiliary load. Added here are the properties
of a bus: gears, sending rates, resolution, sensor noise. Each route is a published table in the folder of recordings
(ROADLOAD_DATA); a missing route is skipped. Each log is diagnosed, with grade shown also as part of the model. fastsim
comes with tools/fastsim_world/requirements.txt.
"""

import argparse
import json
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from fastsim_world.bus import FINE, signals_of
from fastsim_world.roads import ROUTES, road_of
from fastsim_world.truck import Drive, Vehicle, draw_vehicle, followed, simulate
from harness.check import Check, Figures, Table
from harness.drives import data_folder, diagnose

from estimator.answers.diagnosis import DiagnosisAnswer
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.units import STANDARD_GRAVITY

SPEED_NOISE = 0.01  # m/s
EFFECTS = frozenset({"grade", "torque_gain", "auxiliary_load", "rotating_inertia"})  # of fastsim, beyond the road load


def truth_of(vehicle: Vehicle, drive: Drive) -> dict[str, Any]:
    """The truth: the vehicle, and the three parameters at the wheel and, with the driveline's losses, at the crank."""
    A = vehicle.mass * STANDARD_GRAVITY * vehicle.rolling_coefficient
    inertia = vehicle.mass + vehicle.wheels * vehicle.wheel_inertia / vehicle.wheel_radius**2
    at_wheel = {"mass_kg": inertia, "A_N": A, "C_N_s2_m2": drive.C}
    return {
        "vehicle": asdict(vehicle),
        "at_wheel": at_wheel,
        "at_crank": {name: value / vehicle.driveline_efficiency for name, value in at_wheel.items()},
        "auxiliary_kW": vehicle.auxiliary_power / 1e3,
        "driveline_loss": 1 - vehicle.driveline_efficiency,
        "grade_sd": float(np.std(drive.grade[drive.v > 1])),
        "effects": sorted(EFFECTS if np.any(drive.grade) else EFFECTS - {"grade"}),
        "minutes": float(drive.t[-1] / 60),
    }


def judge(truth: dict[str, Any], grade: str, said: DiagnosisAnswer) -> dict[str, Any]:
    """A row of the table: grade must be named where it is withheld, and no absent effect named anywhere.

    A name is right if the answer lists it as equivalent to a present effect.
    """
    there = frozenset(truth["effects"])
    wanted = grade == "withheld" and "grade" in there
    alike = [(effect.name, {effect.name, *effect.equivalent}) for effect in said.effects]
    invented = sorted(name for name, names in alike if not names & there)
    found = any("grade" in names for _, names in alike)
    return {
        "grade": grade,
        "grade sd [%]": 100 * truth["grade_sd"],
        "verdict": said.verdict,
        "named": ", ".join(" or ".join([name, *sorted(names - {name})]) for name, names in alike) or "-",
        "as it should": "yes" if not invented and (found or not wanted) else "NO",
        "invented": ", ".join(invented) or "-",
        "kW before": said.rms_base_kW,
        "kW after": said.rms_final_kW,
    }


def drive_of(route: str, options: argparse.Namespace, tables: Path) -> tuple[Vehicle, Drive]:
    """The truck of a route, independent of the other routes, and its drive."""
    vehicle = draw_vehicle(np.random.default_rng([options.seed, list(ROUTES).index(route), 0]))
    return vehicle, simulate(vehicle, followed(vehicle, road_of(ROUTES[route](tables))))


def diagnosed(route: str, options: argparse.Namespace, tables: Path, folder: Path) -> list[dict[str, Any]]:
    """Write the logs and the truth of a route to ``folder``; a row for each diagnosis."""
    vehicle, drive = drive_of(route, options, tables)
    truth = truth_of(vehicle, drive)
    (folder / f"{route}.truth.json").write_text(json.dumps(truth, indent=2) + "\n")
    rows = []
    for grade in ("shown", "withheld") if options.grade == "both" else (options.grade,):
        log = folder / f"{route}-{grade}.blf"
        # The same noise with and without grade: nothing else differs between the two logs.
        noise = np.random.default_rng([options.seed, list(ROUTES).index(route), 1])
        signals = signals_of(drive, noise, grade == "shown", SPEED_NOISE, FINE)
        write_log(frames_of(signals), log)
        rows.append({"route": route} | judge(truth, grade, diagnose(log)))
        if grade == "shown":
            rows.append({"route": route} | judge(truth, "given", diagnose(log, "--effect", "grade")))
    return rows


def measure(options: argparse.Namespace) -> Figures:
    """Rows of all routes whose tables are there, and the names of the others."""
    tables, rows, missing = data_folder() / "drive_cycles" / "csv", [], []
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.folder or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        for route in options.route or ROUTES:
            try:
                rows += diagnosed(route, options, tables, folder)
            except FileNotFoundError:
                missing.append(route)
    return {"diagnoses": rows, "routes_without_a_table": missing}


def tables(figures: Figures) -> list[Table]:
    """A row for each diagnosis."""
    return [Table.of("fastsim", figures["diagnoses"])]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the routes and the sensors."""
    parser.add_argument("--folder", type=Path, help="logs and truths are kept here")
    parser.add_argument("--route", action="append", choices=sorted(ROUTES), help="default: all")
    parser.add_argument("--grade", choices=["shown", "withheld", "both"], default="both")
    parser.add_argument("--seed", type=int, default=1)


CHECK = Check(name="fastsim", about=__doc__, measure=measure, tables=tables, options=add_options)

if __name__ == "__main__":
    sys.exit(CHECK.main())

"""Class-8 drives simulated independently by NREL's fastsim, as J1939 logs with their truth.

    python tools/check_fastsim.py [--route long-haul vail] [--seed 1]

fastsim computes the power at the engine from speed and grade, step by step at 10 Hz. That is rolling resistance, drag,
climb, inertia of vehicle and wheels, the loss of its drivetrain and a constant auxiliary load. Added here are the
properties of a bus: gears, sending rates, resolution, sensor noise. Each route is a published table in the folder of
recordings (ROADLOAD_DATA); a missing route is skipped. Each log is diagnosed, with grade shown also as part of the
model. fastsim comes with tools/fastsim_world/requirements.txt.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from fastsim_world.bus import FINE, signals_of
from fastsim_world.roads import ROUTES, road_of
from fastsim_world.truck import Drive, draw_vehicle, followed, simulate
from harness.check import Cells, Check, Figures, Table
from harness.drives import data_folder, diagnose

from estimator.answers.diagnosis import DiagnosisAnswer
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log

SPEED_NOISE = 0.01  # m/s
EFFECTS = frozenset({"grade", "torque_gain", "auxiliary_load", "rotating_inertia"})  # of fastsim, beyond the road load


def truth_of(drive: Drive) -> dict[str, Any]:
    """Slopes and effects."""
    effects = EFFECTS if np.any(drive.grade) else EFFECTS - {"grade"}
    return {"grade_sd": float(np.std(drive.grade[drive.v > 1])), "effects": effects}


def judge(truth: dict[str, Any], grade: str, said: DiagnosisAnswer) -> dict[str, Any]:
    """A row of the table: grade must be named where it is withheld, and no absent effect named anywhere.

    A name is right if the answer lists it as equivalent to a present effect.
    """
    there = truth["effects"]
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


def diagnosed(route: str, options: argparse.Namespace, tables: Path, folder: Path) -> list[dict[str, Any]]:
    """Write the logs of a route to ``folder``; a row for each diagnosis."""
    vehicle = draw_vehicle(np.random.default_rng([options.seed, list(ROUTES).index(route), 0]))
    drive = simulate(vehicle, followed(vehicle, road_of(ROUTES[route](tables))))
    truth = truth_of(drive)
    rows = []
    for grade in ("shown", "withheld"):
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
        for route in options.route or ROUTES:
            try:
                rows += diagnosed(route, options, tables, Path(scratch))
            except FileNotFoundError:
                missing.append(route)
    return {"diagnoses": rows, "routes_without_a_table": missing}


def tables(figures: Figures) -> list[Table]:
    """A row for each diagnosis."""
    return [Table.of("fastsim", figures["diagnoses"])]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the routes and the sensors."""
    parser.add_argument("--route", nargs="+", choices=sorted(ROUTES), help="default: all")
    parser.add_argument("--seed", type=int, default=1)


CHECK = Check(
    title="Drives of NREL's fastsim",
    measure=measure,
    tables=tables,
    headline=Cells(columns=("grade", "named", "as it should")),
    options=add_options,
)

if __name__ == "__main__":
    sys.exit(CHECK.main())

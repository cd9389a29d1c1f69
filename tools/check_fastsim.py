"""Class-8 drives simulated independently by NREL's fastsim, as J1939 logs with their truth.

python tools/check_fastsim.py OUT [--route long-haul --route vail] [--grade shown|withheld|both] [--diagnose]

fastsim computes the power at the engine from speed and grade, step by step at 10 Hz: rolling resistance, drag, climb,
inertia of vehicle and wheels, the loss of its drivetrain and a constant auxiliary load. Added here are the
properties of a bus: gears, sending rates, resolution, sensor noise. Each route is a published table in the folder of
recordings (ROADLOAD_DATA); a missing route is skipped. fastsim comes with tools/check_fastsim.txt.
"""

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from fastsim_world.bus import FINE, signals_of
from fastsim_world.roads import ROUTES, road_of
from fastsim_world.truck import Drive, Vehicle, draw_vehicle, followed, simulate
from real_recordings import data_folder, diagnose, print_table

from estimator.answers.diagnosis import DiagnosisAnswer
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.errors import RoadloadError
from estimator.units import STANDARD_GRAVITY

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


def judge(truth: dict[str, Any], grade: str, said: DiagnosisAnswer) -> dict[str, str]:
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
        "grade sd": f"{100 * truth['grade_sd']:.2f} %",
        "verdict": said.verdict,
        "named": ", ".join(" or ".join([name, *sorted(names - {name})]) for name, names in alike) or "-",
        "as it should": "yes" if not invented and (found or not wanted) else "NO",
        "invented": ", ".join(invented) or "-",
        "kW before": "-" if said.rms_base_kW is None else f"{said.rms_base_kW:.2f}",
        "kW after": "-" if said.rms_final_kW is None else f"{said.rms_final_kW:.2f}",
    }


def main(arguments: list[str] | None = None) -> int:
    """Write logs and truths; with --diagnose, diagnose the logs and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path, metavar="OUT", help="folder for logs and truth; made if need be")
    parser.add_argument("--route", action="append", choices=sorted(ROUTES), help="default: all")
    parser.add_argument("--grade", choices=["shown", "withheld", "both"], default="both")
    parser.add_argument("--speed-noise", type=float, default=0.01, metavar="m/s")
    parser.add_argument("--torque-resolution", type=float, default=FINE, metavar="FRACTION")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument(
        "--diagnose",
        action="store_true",
        help="run `roadload diagnose` on them, with grade shown also as part of the model, and print a table",
    )
    options = parser.parse_args(arguments)
    rows = []
    try:
        folder = data_folder() / "drive_cycles" / "csv"
        options.output.mkdir(parents=True, exist_ok=True)
        for route in options.route or ROUTES:
            # Each route has its own truck, independent of the other routes in this run.
            seed = [options.seed, list(ROUTES).index(route)]
            vehicle = draw_vehicle(np.random.default_rng([*seed, 0]))
            try:
                table = ROUTES[route](folder)
            except FileNotFoundError as error:
                print(f"{route}: skipped, there is no {error.filename or error}", file=sys.stderr)
                continue
            drive = simulate(vehicle, followed(vehicle, road_of(table)))
            truth = truth_of(vehicle, drive)
            (options.output / f"{route}.truth.json").write_text(json.dumps(truth, indent=2) + "\n")
            for grade in ("shown", "withheld") if options.grade == "both" else (options.grade,):
                log = options.output / f"{route}-{grade}.blf"
                # The same noise with and without grade: nothing else differs between the two logs.
                noise = np.random.default_rng([*seed, 1])
                signals = signals_of(drive, noise, grade == "shown", options.speed_noise, options.torque_resolution)
                frames = frames_of(signals)
                write_log(frames, log)
                print(f"{log}: {len(frames):,} frames, {truth['minutes']:.0f} min")
                if options.diagnose:
                    rows.append({"route": route} | judge(truth, grade, diagnose(log)))
                if options.diagnose and grade == "shown":
                    rows.append({"route": route} | judge(truth, "given", diagnose(log, "--effect", "grade")))
    except RoadloadError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_status
    if options.diagnose:
        print_table("fastsim", rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())

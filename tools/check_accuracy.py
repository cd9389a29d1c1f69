"""Errors and interval coverage of estimates from simulated drives of different trucks, read through CAN bytes.

    python tools/check_accuracy.py [--drives 20] [--minutes 60] [--seed 1000]
    python tools/check_accuracy.py --hills [--drives 162] [--minutes 40] [--seed 1]

With ``--hills`` every drive has a road of its own. Kind of road, altimeter, noise of the speed and steps of the torque
take turns (54 drives are all combinations); slopes and lag are drawn. The figures of each of these groups are of the
last estimate, so there is one every ten minutes only.
"""

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from harness.check import Cells, Check, Figures, Table, drive_options, percent, progress
from harness.drives import (
    ALTIMETERS,
    KINDS,
    NAMES,
    RARELY,
    SPEED_NOISES,
    TORQUE_STEPS,
    World,
    estimates,
    hills,
    traffic,
)
from harness.scores import Score, summary

from estimator.config import Config, from_dict
from estimator.simulation.recording import Recording

LIMITS = (0.02, 0.015, 0.005)  # errors of the mass below which drives are counted
LEVEL = World(kind="mixed", slopes=0.0, altimeter=None, speed_noise=0.01, torque_steps=0.00125, lag=0.03)
Found = dict[str, Any]


def estimated(recording: Recording, config: Config) -> Found:
    """Minutes to the first mass; the score of each estimated parameter."""
    frames, truck = traffic(recording), recording.truth.truck
    updates = estimates(frames, config)
    first = next((update.t for update in updates if update.mass is not None), None)
    marginals = {name: getattr(updates[-1], name) for name in NAMES}
    scores = {name: asdict(Score.of(x, getattr(truck, name))) for name, x in marginals.items() if x is not None}
    return {"first_min": None if first is None else (first - float(frames.t[0])) / 60, **scores}


def figures_of(results: Sequence[Found]) -> Figures:
    """Errors and coverage of some drives, by parameter."""
    firsts = [result["first_min"] for result in results if result["first_min"] is not None]
    scores = {name: [Score(**result[name]) for result in results if name in result] for name in NAMES}
    return {
        "drives": len(results),
        "first_mass_min": float(np.median(firsts)) if firsts else None,
        **{name: summary(found, LIMITS) for name, found in scores.items()},
    }


def groups(drives: Sequence[tuple[World, Found]]) -> Iterator[tuple[str, list[Found]]]:
    """What shows the road and a further property, and the drives that share both."""
    for shown in ALTIMETERS:
        same = [(world, found) for world, found in drives if world.shown == shown]
        yield f"{shown}, all", [found for _, found in same]
        for kind in KINDS:
            yield f"{shown}, {kind}", [found for world, found in same if world.kind == kind]
        for noise in SPEED_NOISES:
            yield f"{shown}, speed {1000 * noise:g} mm/s", [x for world, x in same if world.speed_noise == noise]
        for steps in TORQUE_STEPS:
            yield f"{shown}, torque {100 * steps:g} %", [x for world, x in same if world.torque_steps == steps]


def measure(options: argparse.Namespace) -> Figures:
    """Figures of drives in one world, or of each group of drives over hills."""
    if options.hills:
        drives = []
        for number in progress(range(options.drives), "driving"):
            rng = np.random.default_rng([options.seed, number])
            world = hills(number, rng)
            drives.append((world, estimated(world.drive(options.minutes, rng), from_dict(RARELY))))
        each = [{"world": asdict(world), **found} for world, found in drives]
        return {"groups": {name: figures_of(found) for name, found in groups(drives)}, "each": each}
    seeds = progress(range(options.seed, options.seed + options.drives), "driving")
    each = [estimated(LEVEL.drive(options.minutes, np.random.default_rng(seed)), Config()) for seed in seeds]
    return {"groups": {"all": figures_of(each)}, "each": each}


def tables(figures: Figures) -> list[Table]:
    """A row a parameter in one world, or a row a group over hills."""
    if "all" in figures["groups"]:
        found = figures["groups"]["all"]
        first = found["first_mass_min"]
        rows = [
            [
                name,
                f"{x['estimated']} of {found['drives']}",
                *(percent(x[key], 2) for key in ("median", "worst", "bias", "sd")),
                f"{x['holds']} of {x['estimated']}",
            ]
            for name in NAMES
            if (x := found[name])["estimated"]
        ]
        title = "" if first is None else f"first mass after {first:.1f} min (median)"
        shown = ("", "estimated", "median error", "worst", "bias", "mean sd", "90 % intervals that hold the truth")
        return [Table(title, shown, rows)]
    limits = [f"within {100 * limit:g} %" for limit in LIMITS]
    rows = []
    for name, found in figures["groups"].items():
        mass = found["mass"]
        if mass["estimated"]:
            counts = [str(mass[f"within_{100 * limit:g}_percent"]) for limit in LIMITS]
            errors = [percent(mass["rms"], 2), percent(mass["bias"], 2, "+")]
            holds = [f"{found[x]['holds']} of {found[x]['estimated']}" for x in NAMES]
            rows.append([name, str(found["drives"]), str(mass["estimated"]), *counts, *errors, *holds])
    columns = ("road", "drives", "masses", *limits, "rms", "bias", "m holds", "A holds", "C holds")
    return [Table("", columns, rows)]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add what is drawn, or the world of all drives."""
    drive_options(drives=20, minutes=60.0, seed=1000)(parser)
    parser.add_argument("--hills", action="store_true", help="a road and sensors of its own for every drive")


CHECK = Check(
    title="Mass, A and C on simulated drives",
    measure=measure,
    tables=tables,
    headline=Cells(
        rows=("mass", "A", "C", *(f"{shown}, all" for shown in ALTIMETERS)),
        columns=("median error", "90 % intervals that hold the truth", "masses", "within 2 %", "rms"),
    ),
    options=add_options,
)

if __name__ == "__main__":
    sys.exit(CHECK.main())

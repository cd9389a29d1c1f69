"""Drive the experiments that the diagnosis advises, and count how many settle what was open.

    python tools/check_experiments.py [--drives 60] [--seed 1]

Each drive has one weak effect. Where the diagnosis advises an experiment, the same truck is simulated with it appended
to the drive, and once more with ordinary driving for as long instead. A question is settled if the longer log names the
true effect, or its class, first. Coasting and the choice of a gear cannot be asked of the simulated driver: they are
counted as not driven.
"""

import argparse
import re
import sys
import tempfile
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from harness.check import Check, Figures, Table, progress
from harness.drives import KINDS, diagnosed, traffic

from estimator.answers.diagnosis import Verdict
from estimator.diagnosis.result import Diagnosis, Experiment
from estimator.report.wording import is_worthwhile
from estimator.simulation.effects.catalogue import kind_of
from estimator.simulation.effects.effect import Effect
from estimator.simulation.itinerary import place_at, plan_route, shaped
from estimator.simulation.recording import record
from estimator.simulation.route import KMH, Route
from estimator.simulation.truck import Truck, draw_truck

DURATION = 900.0  # s, of the drive that leaves a question open
EFFECTS = ("auxiliary_load", "torque_bias", "headwind", "warm_up", "viscous_drag", "rotating_inertia", "sensor_drift")
STEADY, SPACE, DWELL = 140.0, 400.0, 5.0  # s at a speed, m between starts, s at rest before each
SPARE = 1.3  # more time than planned, for gaining speed and braking


@dataclass(frozen=True, kw_only=True)
class Case:
    """One truck on one road, with one effect."""

    truck: Truck
    road: Route
    effect: Effect
    seed: tuple[int, int]


def drawn(seed: int, number: int) -> Case:
    """Truck, road, effect and size."""
    rng = np.random.default_rng([seed, number])
    kind = kind_of(str(rng.choice(EFFECTS)))
    size = float(rng.uniform(0.5 * kind.low, 0.5 * (kind.low + kind.usual))) * (
        float(rng.choice([-1, 1])) if kind.signed else 1.0
    )
    name = next(name for name in EFFECTS if kind_of(name) is kind)
    road = plan_route(KINDS[int(rng.integers(3))], 4 * DURATION, rng)
    return Case(truck=draw_truck(rng), road=road, effect=Effect(name=name, magnitude=size), seed=(seed, number))


def with_experiment(road: Route, experiment: Experiment) -> Route | None:
    """The road with a manoeuvre after DURATION; None where the driver cannot be asked to do it."""
    end = place_at(road, DURATION)
    if "way back" in experiment.what:
        return shaped(road, 2 * DURATION, "out-and-back")
    if "idling" in experiment.what:
        return _after(road, end, np.empty(0), np.empty(0), np.array([end]), np.array([120.0]))
    if "more minutes" in experiment.what:
        return road
    if starts := re.fullmatch(r"(\d+) starts from rest to (\d+) km/h", experiment.what):
        count, top = int(starts[1]), int(starts[2]) * KMH
        stop = end + SPACE * np.arange(count)
        return _after(road, end, np.array([end]), np.array([top]), stop, np.full(count, DWELL))
    if experiment.what.startswith("two minutes each"):
        speeds = np.array([int(told) * KMH for told in re.findall(r"\d+", experiment.what)])
        start = end + np.concatenate([[0.0], np.cumsum(STEADY * speeds)[:-1]])
        return _after(road, end, start, speeds, np.empty(0), np.empty(0))
    return None


def _after(road: Route, end: float, start: np.ndarray, speed: np.ndarray, stop: np.ndarray, dwell: np.ndarray) -> Route:
    """The road up to ``end`` [m], and sections and stops beyond."""
    sections, stops = road.section_start < end, road.stop_position < end
    return replace(
        road,
        section_start=np.append(road.section_start[sections], start),
        section_speed=np.append(road.section_speed[sections], speed),
        stop_position=np.concatenate([road.stop_position[stops], stop, road.stop_position[-1:]]),
        stop_dwell=np.concatenate([road.stop_dwell[stops], dwell, road.stop_dwell[-1:]]),
        curvature=np.zeros(2),
    )


def driven(case: Case, road: Route, duration: float, folder: Path) -> Diagnosis:
    """The diagnosis of the log of a drive on ``road`` of ``duration`` [s]."""
    recording = record(case.truck, road, duration, np.random.default_rng(case.seed), effects=[case.effect])
    return diagnosed(traffic(recording), folder)[0]


def is_right(case: Case, found: Diagnosis) -> bool:
    """Whether the first name is that of the effect, or of its class."""
    if found.verdict is not Verdict.EFFECT:
        return False
    return case.effect.name in (found.effects[0].name, *found.effects[0].equivalent)


def is_settled(case: Case, found: Diagnosis, asked: Experiment) -> bool:
    """Whether that name is right, and the other one that was ``asked`` about is not given beside it."""
    return is_right(case, found) and not {asked.a, asked.b} <= {found.effects[0].name, *found.effects[0].equivalent}


def outcome(case: Case, folder: Path) -> dict[str, Any]:
    """What the diagnosis says, the experiment that it advises, and whether driving it settles the question."""
    found = driven(case, case.road, DURATION, folder)
    advised = next((one for one in found.experiments if is_worthwhile(found, one)), None)
    told: dict[str, Any] = {
        "effect": case.effect.name,
        "magnitude": case.effect.magnitude,
        "verdict": found.verdict.value,
        "right_at_once": is_right(case, found),
    }
    if advised is None:
        return told
    told |= {"advised": advised.what, "between": [advised.a, advised.b or "nothing"]}
    longer = with_experiment(case.road, advised)
    if longer is None:
        return told
    duration = DURATION + SPARE * 60 * advised.minutes
    settled, anyway = (is_settled(case, driven(case, road, duration, folder), advised) for road in (longer, case.road))
    return told | {"expected": advised.expected, "settled": settled, "settled_by_driving_on": anyway}


def measure(options: argparse.Namespace) -> Figures:
    """Every drive, and how many questions were settled."""
    with tempfile.TemporaryDirectory() as folder:
        numbers = progress(range(options.drives), "driving")
        drives = [outcome(drawn(options.seed, number), Path(folder)) for number in numbers]
    tally = Counter(drive["verdict"] for drive in drives)
    counts = {
        "right at once": sum(drive["right_at_once"] for drive in drives),
        "advised": sum("advised" in drive for drive in drives),
        "driven": sum("settled" in drive for drive in drives),
        "settled": sum(drive.get("settled", False) for drive in drives),
        "settled by driving on as long": sum(drive.get("settled_by_driving_on", False) for drive in drives),
    }
    return {"counts": {**dict(sorted(tally.items())), **counts}, "drives": drives}


def tables(figures: Figures) -> list[Table]:
    """The counts, and a row for each experiment that was driven."""
    driven = [drive for drive in figures["drives"] if "settled" in drive]
    return [
        Table.of("", [figures["counts"]]),
        Table.of("Experiments", [{**x, "between": " or ".join(x["between"])} for x in driven]),
    ]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the drives."""
    parser.add_argument("--drives", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)


CHECK = Check(name="experiments", about=__doc__, measure=measure, tables=tables, options=add_options)

if __name__ == "__main__":
    sys.exit(CHECK.main())

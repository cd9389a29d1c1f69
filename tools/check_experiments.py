"""Drive the experiments that the diagnosis advises, and count how many settle what was open.

    python tools/deciding_experiments.py [--drives 60] [--seed 1]

Each drive has one weak effect. Where the diagnosis advises an experiment, the same truck is simulated with it appended
to the drive, and once more with ordinary driving for as long instead. A question is settled if the longer log names the
true effect, or its class, first. Coasting and the choice of a gear cannot be asked of the simulated driver: they are
counted as not driven.
"""

import argparse
import re
import tempfile
from collections import Counter
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from estimator import diagnose_logs, load_config
from estimator.answers.diagnosis import Verdict
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.diagnosis.result import Diagnosis, Experiment
from estimator.report.wording import is_worthwhile
from estimator.simulation.effects.catalogue import kind_of
from estimator.simulation.effects.effect import Effect
from estimator.simulation.itinerary import place_at, plan_route, shaped
from estimator.simulation.recording import record
from estimator.simulation.route import KMH, RoadKind, Route
from estimator.simulation.truck import Truck, draw_truck

DURATION = 900.0  # s, of the drive that leaves a question open
EFFECTS = ("auxiliary_load", "torque_bias", "headwind", "warm_up", "viscous_drag", "rotating_inertia", "sensor_drift")
ROADS: tuple[RoadKind, ...] = ("urban", "mixed", "highway")
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
    road = plan_route(ROADS[int(rng.integers(3))], 4 * DURATION, rng)
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


def diagnosed(case: Case, road: Route, duration: float, folder: Path) -> Diagnosis:
    """The diagnosis of the log of a drive on ``road``."""
    log = folder / "drive.blf"
    recording = record(case.truck, road, duration, np.random.default_rng(case.seed), effects=[case.effect])
    write_log(frames_of(recording.signals), log)
    return diagnose_logs([log], load_config())


def is_right(case: Case, found: Diagnosis) -> bool:
    """Whether the first name is that of the effect, or of its class."""
    if found.verdict is not Verdict.EFFECT:
        return False
    return case.effect.name in (found.effects[0].name, *found.effects[0].equivalent)


def is_settled(case: Case, found: Diagnosis, asked: Experiment) -> bool:
    """Whether that name is right, and the other one that was ``asked`` about is not given beside it."""
    return is_right(case, found) and not {asked.a, asked.b} <= {found.effects[0].name, *found.effects[0].equivalent}


def main(drives: int, seed: int) -> None:
    """Print a line for each experiment, and the shares."""
    tally: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for number in range(drives):
            case = drawn(seed, number)
            found = diagnosed(case, case.road, DURATION, Path(folder))
            advised = [one for one in found.experiments if is_worthwhile(found, one)]
            tally["right at once"] += is_right(case, found)
            tally[found.verdict.value] += 1
            if not advised:
                continue
            tally["advised"] += 1
            longer = with_experiment(case.road, advised[0])
            if longer is None:
                tally["advised, not driven"] += 1
                continue
            duration = DURATION + SPARE * 60 * advised[0].minutes
            settled, anyway = (
                is_settled(case, diagnosed(case, road, duration, Path(folder)), advised[0])
                for road in (longer, case.road)
            )
            tally["driven"] += 1
            tally["driven: settled"] += settled
            tally["driven: settled by driving on as long"] += anyway
            told = f"{case.effect.name} {case.effect.magnitude:.3g}: {advised[0].a} or {advised[0].b or 'nothing'}"
            expected = f"expected {advised[0].expected:.1f}, of the drive {advised[0].now:.1f}"
            print(f"{told}; {advised[0].what}, {expected}: {settled}, driving on {anyway}", flush=True)
    for name, count in sorted(tally.items()):
        print(f"{name}: {count}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=60)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    main(options.drives, options.seed)

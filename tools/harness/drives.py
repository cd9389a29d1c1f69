"""Drives of simulated trucks: a world that is drawn, its traffic, and what the program says of it."""

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from estimator.answers.answer import Answer, decode
from estimator.answers.diagnosis import DiagnosisAnswer
from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.config import Config
from estimator.diagnosis.result import Diagnosis
from estimator.errors import InputError, RoadloadError
from estimator.estimates import Estimate
from estimator.preparation.drive import Drive
from estimator.samples import Rows
from estimator.signals import Role
from estimator.simulation.recording import Recording, record
from estimator.simulation.route import RoadKind, generate_route
from estimator.simulation.sensors import Sensors
from estimator.simulation.truck import Truck, draw_truck
from estimator.streaming.drive_extraction import diagnose_logs, drives_of
from estimator.streaming.pipeline import Pipeline
from estimator.streaming.row_stream import Block
from harness.check import ROOT

NAMES = ("mass", "A", "C")
METRES_PER_MINUTE = 2000.0  # of road, more than any truck drives
OF_THE_ROAD = {Role.ALTITUDE, Role.GRADE, Role.LONGITUDINAL_ACCELERATION}  # signals that show slopes
ALTIMETERS = {"hidden": None, "poor": 5.0, "good": 0.3}  # m, sd of the error, which changes over 30 s
KINDS: tuple[RoadKind, ...] = ("urban", "mixed", "highway")
SPEED_NOISES = (0.0, 0.01, 0.03)  # m/s
TORQUE_STEPS = (0.00125, 0.01)  # of the reference torque
SLOPES = (0.004, 0.016)  # sd, rise over run
LAGS = (0.0, 0.2)  # s, of torque behind speed
RARELY = {"gate": {"interval_s": 600.0}}  # of drives of which the last estimate counts
Answers = TypeVar("Answers", bound=Answer)


@dataclass(frozen=True, kw_only=True)
class World:
    """Road and sensors of a drive: slopes by their sd [1], speed noise [m/s], torque steps [1], lag of torque [s].

    ``altimeter``: sd of its error [m]; None where no signal shows the road.
    """

    kind: RoadKind
    slopes: float
    altimeter: float | None
    speed_noise: float
    torque_steps: float
    lag: float

    @property
    def shown(self) -> str:
        """What shows the road: a key of ALTIMETERS."""
        return next(name for name, noise in ALTIMETERS.items() if noise == self.altimeter)

    def drive(self, minutes: float, rng: np.random.Generator) -> Recording:
        """The drive of a truck drawn at random, of ``minutes`` [min]."""
        noise = {"speed_noise": self.speed_noise, "torque_resolution": self.torque_steps, "torque_lag": self.lag}
        return drive(draw_truck(rng), self.kind, minutes, rng, self.slopes, showing(self.altimeter, **noise))


def drive(
    truck: Truck,
    kind: RoadKind,
    minutes: float,
    rng: np.random.Generator,
    slopes: float = 0.0,
    sensors: Sensors | None = None,
) -> Recording:
    """A drive of ``minutes`` [min] over a road drawn at random, with slopes of a standard deviation [1]."""
    route = generate_route(kind, minutes * METRES_PER_MINUTE, rng, slopes)
    return record(truck, route, 60 * minutes, rng, sensors=sensors)


def showing(altimeter: float | None = None, **noise: float) -> Sensors:
    """Sensors of a bus on which an altimeter of that error [m] alone shows the road, or nothing."""
    without = OF_THE_ROAD - ({Role.ALTITUDE} if altimeter is not None else set())
    return Sensors(altitude_noise=altimeter or 0.0, without=frozenset(without), **noise)


def hills(number: int, rng: np.random.Generator) -> World:
    """The world of drive ``number`` of a set: all combinations take turns, slopes and lag are drawn."""
    return World(
        kind=KINDS[number % 3],
        altimeter=list(ALTIMETERS.values())[number // 3 % 3],
        speed_noise=SPEED_NOISES[number // 9 % 3],
        torque_steps=TORQUE_STEPS[number // 27 % 2],
        slopes=float(rng.uniform(*SLOPES)),
        lag=float(rng.uniform(*LAGS)),
    )


def loaded(truck: Truck, mass: float) -> Truck:
    """The truck with another mass [kg], and the rolling resistance that goes with it."""
    return replace(truck, mass=mass, A=truck.A * mass / truck.mass)


def estimates(frames: Frames, config: Config) -> list[Estimate]:
    """All estimates from the traffic of a drive, the final one last."""
    pipeline = Pipeline(config)
    return [*pipeline.feed(frames), *pipeline.finish()]


def read(frames: Frames, config: Config) -> tuple[Rows, Estimate, float]:
    """The rows of a drive, the last estimate from them, and the lag [s] of power that it found."""
    pipeline = Pipeline(config)
    items = [*pipeline.traffic.feed(frames), *pipeline.traffic.finish()]
    rows = Rows.concatenate(*(rows for item in items if isinstance(item, Block) for rows in item.rows))
    updates = [update for item in items for update in pipeline.take(item)]
    final = [*updates, *pipeline.finish()][-1]
    evidence = pipeline.estimator.evidence
    return rows, final, 0.0 if evidence is None else evidence.lag


def diagnosed(frames: Frames, folder: Path) -> tuple[Diagnosis, Drive]:
    """The diagnosis of a drive from its log in ``folder``, and the drive as it is read from there."""
    log, config = folder / "drive.blf", Config()
    write_log(frames, log)
    return diagnose_logs([log], config), drives_of(log, config)[0]


def traffic(recording: Recording) -> Frames:
    """What is on the bus of a drive."""
    return frames_of(recording.signals)


def roadload(kind: type[Answers], *arguments: str | Path) -> Answers:
    """The answer of a command of the program.

    Raises
    ------
    RoadloadError
        The command failed; the message is the command's.
    """
    command = [sys.executable, "-m", "estimator", *map(str, arguments), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    if done.returncode:
        lines = done.stderr.strip().splitlines()
        raise RoadloadError(lines[-1].removeprefix("error: ") if lines else f"exit status {done.returncode}")
    return decode(done.stdout, kind)


def diagnose(*arguments: str | Path) -> DiagnosisAnswer:
    """The answer of `roadload diagnose` with these arguments."""
    return roadload(DiagnosisAnswer, "diagnose", *arguments)


def named(answer: DiagnosisAnswer) -> tuple[str, ...]:
    """Names of the effects, in order of adding."""
    return tuple(effect.name for effect in answer.effects)


def data_folder() -> Path:
    """Folder of the real recordings, which are no part of the project.

    Raises
    ------
    InputError
        The folder does not exist.
    """
    folder = Path(os.environ.get("ROADLOAD_DATA", "recordings"))
    if not folder.is_dir():
        raise InputError(f"no recordings at {folder}; set ROADLOAD_DATA")
    return folder


def numbered(drives: int, altimeter: str) -> Sequence[int]:
    """Numbers of the first ``drives`` of a set over `hills` whose road is shown by this altimeter."""
    place = list(ALTIMETERS).index(altimeter)
    return [9 * (i // 3) + 3 * place + i % 3 for i in range(drives)]

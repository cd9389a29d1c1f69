"""Simulated drives as log files, and the JSON that the commands print of them."""

import json
from collections.abc import Iterable
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from estimator.answers.answer import Answer, decode, encode
from estimator.answers.diagnosis import DiagnosisAnswer
from estimator.answers.fleet import FleetAnswer
from estimator.answers.inspection import InspectionAnswer
from estimator.answers.run import RunAnswer
from estimator.answers.simulation import SimulationAnswer
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.commands.main import main
from estimator.signals import Role
from estimator.simulation.effects.effect import Effect
from estimator.simulation.itinerary import Shape
from estimator.simulation.recording import Recording, simulate
from estimator.simulation.route import RoadKind
from estimator.simulation.sensors import Sensors
from estimator.simulation.truck import Truck

ANSWERS: dict[str, type[Answer]] = {
    "estimate": RunAnswer,
    "replay": RunAnswer,
    "diagnose": DiagnosisAnswer,
    "inspect": InspectionAnswer,
    "check": InspectionAnswer,
    "simulate": SimulationAnswer,
    "fleet": FleetAnswer,
}
TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)  # the dyno truth of the paper
CLIMB = (Role.GRADE, Role.ALTITUDE, Role.LONGITUDINAL_ACCELERATION)


def drive(
    kind: RoadKind,
    minutes: float,
    seed: int,
    *effects: Effect,
    shape: Shape = "one-way",
    without: Iterable[Role] = (),
    **sensors: float,
) -> Recording:
    """A drive of TRUCK; ``sensors`` as `Sensors` takes them."""
    measured = Sensors(without=frozenset(without), **sensors)
    rng = np.random.default_rng(seed)
    return simulate(TRUCK, kind, 60 * minutes, rng, shape=shape, effects=effects, sensors=measured)


def written(recording: Recording, path: Path) -> Path:
    """The drive as a log."""
    write_log(frames_of(recording.signals), path)
    return path


def ask(*arguments: object) -> dict[str, Any]:
    """The JSON that a command prints; it must succeed, and the JSON must be of its type."""
    out = StringIO()
    with redirect_stdout(out):
        status = main([*map(str, arguments), "--json"])
    assert status == 0
    answer: dict[str, Any] = json.loads(out.getvalue())
    typed = decode(out.getvalue(), ANSWERS[str(arguments[0])])
    assert json.loads(encode(typed)) == answer  # no key that its type does not have
    return answer


def named(answer: dict[str, Any]) -> list[str]:
    """The effects of a diagnosis, in order."""
    return [effect["name"] for effect in answer["effects"]]

"""Gap budget and names of effects on drives with hills, wind, cold tyres and auxiliaries at once.

    python tools/check_budget.py [--drives 24] [--minutes 60] [--seed 1]

Every second drive has a further effect. The road is hidden, shown by a poor altimeter (3 m) or by a good one (0.3 m),
on a third of the drives each. The shares in the budget of `roadload diagnose` are compared with the powers of the
simulated truck, and the names with its effects. An oracle knows the true course and times of all effects, but of the
road only the signals that are on the bus. By its log Bayes factor, less what times that nobody tells cost, an extra
effect is visible on a drive or not.
"""

import argparse
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from blind.truth import DETECTABLE
from harness.check import Cells, Check, Figures, Table, drive_options, progress
from harness.drives import METRES_PER_MINUTE, diagnosed, showing, traffic

from estimator.answers.diagnosis import Verdict
from estimator.components.budget import NOISE, ROAD, WHITE
from estimator.components.drive_state import DriveState
from estimator.components.plain_model import PlainModel
from estimator.components.term import Frame, Term
from estimator.components.time_prior import prior_cost
from estimator.model.effects import BY_NAME
from estimator.model.effects.effect import Timing
from estimator.preparation.drive import Drive
from estimator.signals import Floats, Role
from estimator.simulation.effects.catalogue import effects_from, kind_of
from estimator.simulation.recording import Recording, record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import draw_truck
from estimator.simulation.truth import Truth

# Smallest and largest size, in the units of the simulation (`simulation/effects/catalogue.py`).
NATURAL = {"headwind": (1.0, 5.0), "warm_up": (0.1, 0.3), "auxiliary_load": (2e3, 8e3)}
EXTRA = {
    "auxiliary_cycling": (15e3, 35e3),
    "mass_step": (0.2, 0.5),
    "resistance_segment": (0.2, 0.5),
    "brake_use": (3e3, 6e3),
    "sensor_drift": (0.05, 0.2),
}
ALTIMETERS = {"hidden": None, "poor": 3.0, "good": 0.3}  # m
SLOPES = (0.004, 0.014)  # sd of the grade, rise over run
MAX_SHARE_ERROR = 0.05  # of the gap: largest error of a share that counts as right


@dataclass(frozen=True)
class World:
    """One drive: how its road is shown, the extra effect or none, and the recording."""

    shown: str
    extra: str
    recording: Recording


def draw(number: int, seed: int, minutes: float) -> World:
    """Drive ``number`` of the set ``seed``, of ``minutes`` [min]."""
    rng = np.random.default_rng([seed, number])
    truck, shown = draw_truck(rng), list(ALTIMETERS)[number % 3]
    effects = {name: float(rng.uniform(*sizes)) for name, sizes in NATURAL.items()}
    extra = str(rng.choice(list(EXTRA))) if number % 2 else ""
    if extra:
        effects[extra] = float(rng.uniform(*EXTRA[extra]))
    kind = rng.choice(["mixed", "highway", "urban"])
    route = generate_route(kind, METRES_PER_MINUTE * minutes, rng, float(rng.uniform(*SLOPES)))
    sensors = showing(ALTIMETERS[shown])
    sensors = replace(sensors, without=sensors.without | {Role.FAN_SPEED})
    return World(shown, extra, record(truck, route, 60 * minutes, rng, sensors=sensors, effects=effects_from(effects)))


def mean_power(truth: Truth, name: str, t: Floats) -> Floats:
    """Mean over the seconds around the times ``t`` (n,) [s] of what an effect adds to the power (n,) [W]."""
    total = np.concatenate([[0.0], np.cumsum(truth.effect_power[name][:-1] * np.diff(truth.t))])
    at = truth.t - truth.t[0]
    over: Floats = np.interp(t + 0.5, at, total) - np.interp(t - 0.5, at, total)
    return over


def fitted(drive: Drive) -> DriveState:
    """The drive with the road as a state and without effects."""
    plain = DriveState.of(drive.strides)
    assert plain is not None
    return plain


def true_shares(recording: Recording, plain: DriveState, start: float) -> dict[str, float]:
    """Share of each effect of the truck in the plain model's residual, by its name in the diagnosis.

    The drive begins at ``start`` [s].
    """
    model = PlainModel(plain.fit)
    t = plain.fit.strides.t - start
    residual = model.residual(model.power)
    shares: dict[str, float] = {}
    for name in recording.truth.effect_power:
        known = ROAD if name == "grade" else kind_of(name).known_as or name
        power = model.residual(mean_power(recording.truth, name, t))
        shares[known] = shares.get(known, 0.0) + float(residual @ power / (residual @ residual))
    return shares


def visibility(recording: Recording, plain: DriveState, start: float, extra: str) -> float:
    """Log Bayes factor of an effect with its true course beside the others, A, C, m, lag and the road.

    The road is known as far as the signals on the bus show it, and the scales of road and noise are found with the
    effect and without it: a wander of the altimeter may hold what a wet road does to the height. Times cost what they
    are improbable by. The drive begins at ``start`` [s].
    """
    names = [name for name in recording.truth.effect_power if name not in ("grade", extra)]

    def term(name: str) -> Term:
        def columns(frame: Frame) -> Floats:
            power = mean_power(recording.truth, name, frame.strides.t - start)
            return frame.as_acceleration(power)[:, None]

        return Term(name=name, columns=columns, sd=1.0)  # of its true size, which is 1

    others = tuple(term(name) for name in names)
    without, beside = (plain.with_terms((), each).log_evidence for each in (others, (*others, term(extra))))
    spans, effect = recording.truth.active.get(extra, []), BY_NAME[extra]
    times = tuple((start + begin, start + end) for begin, end in spans)
    cost = prior_cost(times, effect, plain.fit.strides.t) if times and effect.timing is not Timing.STEP else 0.0
    return beside - without - cost


def score(world: World, folder: Path) -> dict[str, Any]:
    """Diagnose a drive from its log and compare."""
    diagnosis, driven = diagnosed(traffic(world.recording), folder)
    assert diagnosis.budget is not None
    plain = fitted(driven)
    truth = true_shares(world.recording, plain, driven.start)
    parts = {part.cause: part for part in diagnosis.budget.parts}
    found = {cause: part.share for cause, part in parts.items()}
    rest = 1 - sum(truth.values())
    truth |= {NOISE: rest}
    found[NOISE] = found.get(NOISE, 0.0) + found.pop(WHITE, 0.0)
    causes = {*truth, *(cause for cause in found if cause in BY_NAME)}
    errors = {cause: found.get(cause, 0.0) - truth.get(cause, 0.0) for cause in sorted(causes)}
    effects = diagnosis.effects if diagnosis.verdict is Verdict.EFFECT else ()
    named = [[effect.name, *effect.equivalent] for effect in effects if effect.name != "grade"]
    there = {*NATURAL, world.extra, *(("torque_bias",) if "auxiliary_load" in NATURAL else ())}
    road = parts.get(ROAD)  # None: the drive is explained by a level road
    return {
        "shown": world.shown,
        "extra": world.extra,
        "extra_share": truth.get(world.extra, 0.0),
        "extra_log_bayes_factor": (
            visibility(world.recording, plain, driven.start, world.extra) if world.extra else 0.0
        ),
        "extra_named": any(world.extra in names for names in named),
        "wrong": [names[0] for names in named if not there & set(names)],
        "named": [names[0] for names in named],
        "within": sum(abs(error) < MAX_SHARE_ERROR for error in errors.values()),
        "shares": len(errors),
        "road": [truth[ROAD], *((0.0, 0.0, 0.0) if road is None else (road.share, road.q05, road.q95))],
        "worst": max(errors.items(), key=lambda item: abs(item[1])),
    }


def totals(rows: list[dict[str, Any]]) -> Figures:
    """Counts over all drives, each with the number it is out of."""
    clear = [row for row in rows if row["extra_log_bayes_factor"] > DETECTABLE]

    def summed(key: str) -> int:
        return sum(row[key] for row in rows)

    return {
        f"shares within {MAX_SHARE_ERROR:.0%}": [summed("within"), summed("shares")],
        "90 % interval of the road's share holds": [
            sum(row["road"][2] <= row["road"][0] <= row["road"][3] for row in rows),
            len(rows),
        ],
        "extra effect visible to the oracle named": [sum(row["extra_named"] for row in clear), len(clear)],
        "drives with a wrong name": [sum(bool(row["wrong"]) for row in rows), len(rows)],
    }


def measure(options: argparse.Namespace) -> Figures:
    """Every drive, and the totals."""
    with tempfile.TemporaryDirectory() as folder:
        numbers = progress(range(options.drives), "driving")
        rows = [score(draw(number, options.seed, options.minutes), Path(folder)) for number in numbers]
    return {"drives": rows, "totals": totals(rows)}


def row_of(found: dict[str, Any]) -> list[str]:
    """A drive as cells of the table."""
    truth, share, low, high = found["road"]
    return [
        found["shown"],
        found["extra"],
        f"{found['extra_share']:.3f}" if found["extra"] else "",
        f"{found['extra_log_bayes_factor']:.0f}" if found["extra"] else "",
        " ".join(found["named"]),
        " ".join(found["wrong"]),
        f"{found['within']} of {found['shares']}",
        f"{truth:.3f}",
        f"{share:.3f} ({low:.3f} .. {high:.3f})",
        f"{found['worst'][0]} {found['worst'][1]:+.3f}",
    ]


def tables(figures: Figures) -> list[Table]:
    """A row for each drive, and the totals."""
    heads = ("extra", "its share", "log BF", "named", "wrong", "shares right", "road: truth", "found", "worst")
    counts = [[name, f"{hits} of {number}"] for name, (hits, number) in figures["totals"].items()]
    drives = [row_of(found) for found in figures["drives"]]
    return [Table("", ("all drives", "count"), counts), Table("Drives", ("road", *heads), drives)]


CHECK = Check(
    title="Budget of the gap",
    measure=measure,
    tables=tables,
    headline=Cells(),
    options=drive_options(drives=24, minutes=60.0),
)

if __name__ == "__main__":
    sys.exit(CHECK.main())

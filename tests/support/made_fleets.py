"""Results of drives drawn from a known truth, without logs, joined to a fleet."""

from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from estimator.config import Config
from estimator.estimates import Marginal
from estimator.fleet.drive_result import DriveResult, FoundEffect, Parameter, Segment
from estimator.fleet.engine import Serial
from estimator.fleet.grouping import Drive, Grouped, Rejected
from estimator.fleet.page import Tables, page
from estimator.fleet.rows import drive_rows, effect_rows, season_rows, vehicle_rows
from estimator.fleet.run import Fleet, conclude

DAY = 86_400.0  # s
FIRST = datetime(2024, 1, 10, 6, tzinfo=UTC).timestamp()  # s
ROLLING, DRAG = 0.062, 3.7  # of the type: A/m [N/kg], C [N s^2/m^2]
SD = np.array([0.004, 0.06, 0.06])  # relative, of m, A/m and C by a drive
WINTER_DRAG = 1.08  # in December to February, for the air is denser


@dataclass(frozen=True)
class Case:
    """A fleet, and the true A/m and C of its vehicles by name."""

    fleet: Fleet
    truth: dict[str, tuple[float, float]]


def made(
    vehicles: int, drives: int, seed: int, *, days: float = 3.0, outlier: str = "", with_diagnosis: bool = False
) -> Case:
    """``drives`` of each vehicle, one every ``days``; C of the vehicle ``outlier`` is 35 % too high."""
    rng = np.random.default_rng(seed)
    truth, all_drives, results = {}, [], []
    for v in range(vehicles):
        name = f"truck-{v + 1:02d}"
        factors = 1 + 0.03 * rng.standard_normal(2)
        truth[name] = ROLLING * factors[0], DRAG * factors[1] * (1.35 if name == outlier else 1.0)
        for i in range(drives):
            start = FIRST + i * days * DAY + 600.0 * v
            all_drives.append(_drive(name, i, start))
            winter = WINTER_DRAG if datetime.fromtimestamp(start, UTC).month in (12, 1, 2) else 1.0
            results.append(_result(rng, truth[name][0], truth[name][1] * winter, start, with_diagnosis))
    rejected = Rejected(
        vehicle="truck-01", source="logs/truck-01/<cut>.blf", start=FIRST, status="unreadable", reason="cut at byte 700"
    )
    notes = {all_drives[0].sources[0]: "the clock is +3.0 years from that of most drives of truck-01"}
    grouped = Grouped(tuple(all_drives), (rejected,), notes)
    return Case(conclude(grouped, tuple(results), Config(), Serial()), truth)


def _drive(vehicle: str, number: int, start: float) -> Drive:
    source = f"logs/{vehicle}/{number:03d}.blf"
    return Drive(vehicle=vehicle, sources=(source,), contents=(source,), start=start, end=start + 3600.0)


def _result(rng: np.random.Generator, rolling: float, drag: float, start: float, with_diagnosis: bool) -> DriveResult:
    mass = rng.uniform(14e3, 36e3)
    truth = np.array([mass, rolling, drag]) * (1 + np.array([0.0, 0.04, 0.04]) * rng.standard_normal(3))
    m, a, C = truth * (1 + SD * rng.standard_normal(3))
    jacobian = np.array([[-1 / m**2, 0, 0], [0, 1, 0], [-C / m**2, 0, 1 / m]])  # of [1/m, A/m, C/m]
    covariance = jacobian @ np.diag((SD * [m, a, C]) ** 2) @ jacobian.T
    values = {"m": (m, SD[0]), "A": (a * m, SD[1]), "C": (C, SD[2])}
    segment = Segment(
        start=start,
        minutes=60.0,
        status="estimated",
        reason="",
        parameters={name: Parameter("estimated", "", _marginal(*value)) for name, value in values.items()},
        mean=[1 / m, a, C / m],
        covariance=covariance.tolist(),
    )
    if not with_diagnosis:
        return DriveResult(segments=(segment,))
    effect = FoundEffect(
        name="headwind",
        probability=0.95,
        log_bayes_factor=12.0,
        quantity="wind",
        magnitude=float(rng.normal(5, 1)),
        sd=0.5,
        unit="m/s",
    )
    found = rng.uniform() < 0.3
    return DriveResult(segments=(segment,), verdict="effect" if found else "no gap", effects=(effect,) if found else ())


def _marginal(value: float, relative_sd: float) -> Marginal:
    low, high = (value * (1 + 1.645 * side * relative_sd) for side in (-1, 1))
    return Marginal(mean=value, sd=value * relative_sd, q05=low, q50=value, q95=high)


def page_of(fleet: Fleet) -> str:
    return page(
        Tables(
            drives=drive_rows(fleet),
            vehicles=vehicle_rows(fleet, 0.05),
            seasons=season_rows(fleet),
            effects=effect_rows(fleet),
            road=fleet.road,
            rate=0.05,
        )
    )

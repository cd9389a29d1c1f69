"""A speed that is read too large or too small is noticed, by other signals, by limits, or by what goes together."""

import io
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from estimator.can_io.j1939_encoder import frames_of
from estimator.commands.status_table import _print_estimate
from estimator.config import Config, from_dict
from estimator.estimates import Coverage, Estimate, Status
from estimator.estimation.log_counts import LogCounts
from estimator.estimation.scale_check import MAX_GEARING, MIN_GEARING, Motion, ScaleCheck
from estimator.estimation.usual_vehicles import Doubt, Size, unusual
from estimator.report import summary
from estimator.samples import STEP, Rows
from estimator.signals import Role
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.pipeline import Pipeline
from estimator.units import EARTH_RADIUS

NAMES = {"speed": "VEHICLE.Speed", "gps_speed": "GPS.Speed", "engine_speed": "ENGINE.Speed"}
MASSES = (500.0, 100_000.0)
ESSENTIAL = {
    *("speed", "engine_speed", "torque_fraction", "torque_fraction_fine", "friction_fraction", "reference_torque"),
    *("brake_switch", "gear", "shift_in_process", "driveline_engaged", "altitude"),
}


def rows_of(factor: float, **context) -> Rows:
    """A drive of 10 min whose speed is read ``factor`` times too large; ``context`` from its true speed [m/s]."""
    t = STEP * np.arange(6000)
    v = 15 + 8 * np.sin(t / 40)
    return Rows(
        index=np.arange(6000),
        speed=factor * v,
        power=np.full(6000, 2e4),
        fresh=np.ones((6000, 2), bool),
        context={Role[name.upper()]: make(v) for name, make in context.items()},
    )


def checked(rows: Rows) -> ScaleCheck:
    check = ScaleCheck(NAMES)
    for start in range(0, len(rows), 200):
        check.add(rows[start : start + 200])
    return check


def north(v):
    return 0.8 + np.cumsum(v * STEP) / EARTH_RADIUS


OTHERS = {
    "gps": {"gps_speed": lambda v: v},
    "wheels": {"wheel_speeds": lambda v: v},
    "positions": {"latitude": north, "longitude": lambda v: 0 * v},
    "yaw": {"yaw_rate": lambda v: 1 / v, "lateral_acceleration": lambda v: 1 + 0 * v},
}


@pytest.mark.parametrize("other", OTHERS)
@pytest.mark.parametrize(
    ("factor", "unit"), [(1.609, "km/h, labelled mph"), (1 / 3.6, "m/s, labelled km/h"), (12.3, "factor of 0.081")]
)
def test_another_signal_of_the_same_motion_tells_the_factor(other, factor, unit):
    verdict = checked(rows_of(factor, **OTHERS[other])).verdict()
    assert "VEHICLE.Speed" in verdict
    assert unit in verdict


@pytest.mark.parametrize("other", OTHERS)
def test_worn_tyres_and_an_outage_of_the_other_signal_are_no_contradiction(other):
    rows = rows_of(1.03, **OTHERS[other])
    for values in rows.context.values():
        values[2000:4000] = values[2000]  # the receiver repeats its last value
    assert checked(rows).verdict() == ""


def test_limits_of_all_vehicles_are_named_with_the_least_factor():
    assert "432 km/h" not in checked(rows_of(4.0)).verdict()
    assert "reads at least" in checked(rows_of(12.3)).verdict()
    geared = checked(rows_of(12.3 / 3, engine_speed=lambda v: 5.4 * v))
    assert "ENGINE.Speed" in geared.verdict()
    assert "1.3" in geared.verdict()


def test_a_limit_that_is_just_exceeded_is_said_as_a_share():
    """ "1 times too large" says nothing."""
    geared = checked(rows_of(1.0, engine_speed=lambda v: MIN_GEARING / 1.03 * v)).verdict()
    assert re.search("reads at least [2-5] % too large", geared)
    geared = checked(rows_of(1.0, engine_speed=lambda v: 1.03 * MAX_GEARING * v)).verdict()
    assert re.search("reads at least [2-5] % too small", geared)


def test_one_gear_is_told_from_several():
    one = checked(rows_of(1.0, engine_speed=lambda v: 27.6 * v)).motion
    assert one is not None
    assert one.gearing == pytest.approx(27.6, rel=0.02)
    assert not one.is_single  # it never went at a walking pace
    walking = rows_of(0.1, engine_speed=lambda v: 2.76 * v)
    joined = ScaleCheck(NAMES)
    for rows in (walking, rows_of(1.0, engine_speed=lambda v: 27.6 * v)):
        joined.add(rows)
    assert joined.motion is not None
    assert joined.motion.is_single


def test_a_check_that_is_restored_says_the_same():
    check = checked(rows_of(1.609, gps_speed=lambda v: v))
    other = ScaleCheck(NAMES)
    other.restore(check.state())
    assert other.verdict() == check.verdict() != ""
    assert other.motion == check.motion


def test_quantiles_of_counts_are_within_a_bin():
    counts = LogCounts()
    values = np.exp(np.random.default_rng(1).normal(1, 0.5, 5000))
    counts.add(np.concatenate([values, [np.nan, -1.0, 0.0]]))
    assert len(counts) == 5000
    for share in (0.1, 0.5, 0.99):
        assert counts.quantile(share) == pytest.approx(np.quantile(values, share), rel=0.025)


def sized(factor: float, mass: float, A: float, C: float, gearing: float, fastest: float, is_single: bool = False):
    size = Size(A=A, C=C, mass=mass, sd=0.1 * np.array([A, C, mass]), power=10 * mass).scaled(1 / factor)
    motion = Motion(fastest * factor, gearing / factor, is_single, None)
    return unusual(size, motion, "speed (VEHICLE.Speed)", MASSES)


TRUCK = {"mass": 27_190.0, "A": 1739.0, "C": 3.74, "gearing": 5.4, "fastest": 24.6}
CAR = {"mass": 1600.0, "A": 180.0, "C": 0.36, "gearing": 27.6, "fastest": 36.0, "is_single": True}


@pytest.mark.parametrize("factor", [1.609, 1 / 1.609, 2.237, 1 / 2.237, 1 / 3.6])
def test_a_truck_in_the_wrong_unit_goes_together_with_nothing(factor):
    doubt = sized(factor, **TRUCK)
    assert doubt.is_certain
    reason = doubt.sentence
    assert "VEHICLE.Speed" in reason
    assert f"{1 / factor:.3g} would fit" in reason
    wrong = f"{factor:.3g} times too large" if factor > 1 else f"{1 / factor:.3g} times too small"
    assert f"speed (VEHICLE.Speed) may read {wrong}: check its unit" in reason


@pytest.mark.parametrize(
    "vehicle",
    [
        TRUCK,
        CAR,
        TRUCK | {"A": 6000.0},  # friction is not subtracted, or a snow plough
        TRUCK | {"C": 6.5},  # a head wind
        TRUCK | {"fastest": 39.0},  # downhill, on a motorway without a limit
        TRUCK | {"gearing": 3.2},  # an axle that is geared long
        {"mass": 12_000.0, "A": 700.0, "C": 3.0, "gearing": 9.0, "fastest": 12.0},  # a bus in a town
        {"mass": 3500.0, "A": 350.0, "C": 1.1, "gearing": 8.5, "fastest": 40.0},  # a van
        {"mass": 2100.0, "A": 230.0, "C": 0.45, "gearing": 4.6, "fastest": 60.0},  # a sports car
    ],
)
def test_a_vehicle_that_is_unusual_in_one_respect_is_believed(vehicle):
    assert sized(1.0, **vehicle) == Doubt()


def test_a_car_with_one_gear_in_the_wrong_unit_is_a_doubt():
    """Sizes of a BMW i3 whose km/h are read as mph."""
    doubt = sized(1.609, mass=1600.0, A=160.0, C=0.3, gearing=27.4, fastest=22.0, is_single=True)
    assert not doubt.is_certain
    assert doubt.sentence.startswith("few vehicles have these values together: 618 kg, ")
    assert "speed (VEHICLE.Speed) may read 1.61 times too large" in doubt.sentence


def test_sizes_that_the_drive_does_not_tell_say_nothing():
    size = Size(A=10.0, C=0.01, mass=27_190.0, sd=np.array([1000.0, 5.0, 300.0]), power=3e5)
    assert unusual(size, Motion(24.0, 5.4, False, None), "speed", MASSES) == Doubt()


def mislabelled(folder: Path, unit: str) -> Config:
    """The shipped database with another unit of the speed, and what a bus has at least."""
    text = Path("dbc/j1939.dbc").read_text()
    wrong = re.sub(r'(SG_ WheelBasedVehicleSpeed .*?\]) "km/h"', rf'\1 "{unit}"', text)
    assert wrong != text
    (folder / "wrong.dbc").write_text(wrong)
    signals = {role: path for role, path in Config().binding.items() if role in ESSENTIAL}
    gate = {"interval_s": 3600.0}
    return from_dict({"bus": {"dbc": [str(folder / "wrong.dbc")]}, "signals": signals, "gate": gate})


@pytest.mark.slow
def test_kilometres_labelled_miles_withhold_the_mass_of_a_bus_without_a_second_speed(tmp_path):
    rng = np.random.default_rng(1)
    truck = Truck(mass=27_190.0, A=1739.0, C=3.74)
    frames = frames_of(record(truck, generate_route("mixed", 60e3, rng), 1500.0, rng).signals)
    pipeline = Pipeline(mislabelled(tmp_path, "mph"))
    final: Estimate = [*pipeline.feed(frames), *pipeline.finish()][-1]
    assert final.status == Status.INVALID
    assert final.mass is None
    assert "CCVS1.WheelBasedVehicleSpeed" in final.reason
    assert "a factor of 0.622 would fit (in km/h, labelled mph?)" in final.reason


def test_a_doubt_stands_beside_the_estimate():
    estimate = Estimate(
        t=60.0,
        status=Status.ESTIMATED,
        reason="",
        coverage=Coverage(1, 2),
        admitted=600,
        doubt="few have this",
    )
    told = summary.conclusion(estimate, 61.0, 0.0)
    assert told is not None
    assert told.doubt == "few have this"
    console = Console(file=io.StringIO(), width=80)
    _print_estimate(console, SimpleNamespace(estimate=told, progress=None))
    assert "warning   few have this\n" in console.file.getvalue()

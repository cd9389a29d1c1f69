"""When the model cannot describe the data, no number is published."""

from functools import cache

import numpy as np
import pytest

from estimator.can_io.j1939_encoder import frames_of
from estimator.config import from_dict
from estimator.estimates import Estimate, Status
from estimator.signals import Role, Series, Signals
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.sensors import Sensors
from estimator.simulation.truck import Truck
from estimator.streaming.pipeline import Pipeline

ONCE = {"interval_s": 3600.0}  # of the gate: only the conclusion at the end of the drive
WIDE = {"gate": {**ONCE, "relative_sd": [9.0, 9.0, 9.0], "coverage": 0.0}}


@pytest.fixture(scope="module")
def broken() -> Estimate:
    """A truck whose bus reports a torque that its engine does not have."""
    rng = np.random.default_rng(5)
    recording = record(Truck(mass=20_000.0, A=1200.0, C=3.5), generate_route("mixed", 60e3, rng), 1000.0, rng)
    signals = dict(recording.signals)
    torque = signals[Role.TORQUE_FRACTION]
    wild = 0.5 + 0.4 * np.sin(2 * np.pi * torque.t / 23)
    signals[Role.TORQUE_FRACTION] = Series(torque.t, wild)
    pipeline = Pipeline(from_dict(WIDE))
    return [*pipeline.feed(frames_of(signals)), *pipeline.finish()][-1]


@pytest.mark.slow
def test_invalid_says_why_and_gives_no_numbers(broken):
    assert broken.status in (Status.INVALID, Status.UNESTIMATED)
    assert broken.reason
    assert broken.mass is None


@cache
def good_drive() -> Signals:
    rng = np.random.default_rng(1)
    truck = Truck(mass=27_190.0, A=1739.0, C=3.74)
    return record(truck, generate_route("mixed", 60e3, rng), 1200.0, rng).signals


def conclude(change, tables: dict | None = None) -> Estimate:
    """What a good drive comes to after something in it or in the configuration is made wrong."""
    signals = dict(good_drive())
    change(signals)
    pipeline = Pipeline(from_dict({"gate": ONCE} | (tables or {})))
    return [*pipeline.feed(frames_of(signals)), *pipeline.finish()][-1]


def rescale(role: Role, factor: float, delay: float = 0.0):
    def change(signals: dict[Role, Series]) -> None:
        signals[role] = Series(signals[role].t + delay, signals[role].value * factor)

    return change


@pytest.mark.slow
def test_a_speed_in_the_wrong_unit_is_seen_by_the_gps():
    final = conclude(rescale(Role.SPEED, 1 / 1.609))
    assert final.status == Status.INVALID
    assert "is 0.62" in final.reason
    assert "times the GPS speed" in final.reason


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.7, 2.0, *(pytest.param(delay, marks=pytest.mark.nightly) for delay in (1.0, 5.0))])
def test_a_speed_that_comes_far_too_late_gives_no_number_or_an_honest_one(delay):
    final = conclude(rescale(Role.SPEED, 1.0, delay))
    if final.status == Status.ESTIMATED:
        assert final.mass is not None
        assert abs(final.mass.mean - 27_190) < 3 * final.mass.sd
    else:
        assert final.mass is None


@pytest.mark.slow
def test_torque_of_the_wrong_sign_is_named():
    final = conclude(rescale(Role.TORQUE_FRACTION, -1.0))
    assert final.status == Status.UNESTIMATED
    assert "sign of the torque" in final.reason


@pytest.mark.slow
def test_a_belief_that_the_drive_contradicts_is_not_averaged_in():
    final = conclude(lambda signals: None, {"prior": {"mass_belief_kg": [10_000, 10]}})
    assert final.status == Status.INVALID
    assert "the configuration believes 1e+04" in final.reason


@pytest.mark.slow
def test_a_poor_speed_sensor_is_no_misfit():
    rng = np.random.default_rng(11_001)
    truck = Truck(mass=30_000.0, A=2000.0, C=3.7)
    sensors = Sensors(speed_noise=0.1)
    recording = record(truck, generate_route("highway", 60e3, rng), 1200.0, rng, sensors=sensors)
    pipeline = Pipeline(from_dict(WIDE))
    final = [*pipeline.feed(frames_of(recording.signals)), *pipeline.finish()][-1]
    assert final.status == Status.ESTIMATED
    assert final.mass is not None
    assert abs(final.mass.mean - truck.mass) < 3 * final.mass.sd

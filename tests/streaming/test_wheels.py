"""Four wheel speeds of which some are dead, frozen or in another unit; and such a bus from bytes to the mass."""

from pathlib import Path

import can
import cantools
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from estimator.can_io.frames import Frames
from estimator.config import from_dict
from estimator.estimates import Estimate, Status
from estimator.streaming.pipeline import Pipeline
from estimator.streaming.wheels import DIFFERS, STANDS_STILL, UNDECIDED, Wheels

PLACES = [0, 1, 2, 3]
DBC = """VERSION ""
BU_: ECU
BO_ 256 WHEELS: 8 ECU
 SG_ FrontLeft : 0|16@1+ (0.1,0) [0|0] "km/h" X
 SG_ FrontRight : 16|16@1+ (0.1,0) [0|0] "km/h" X
 SG_ RearLeft : 32|16@1+ (0.1,0) [0|0] "km/h" X
 SG_ RearRight : 48|16@1+ (0.1,0) [0|0] "km/h" X

BO_ 257 ENGINE: 8 ECU
 SG_ Power : 0|16@1- (0.1,0) [0|0] "kW" X
 SG_ Brake : 16|1@1+ (1,0) [0|1] "" X
"""
MASS = 1500.0  # kg, of the car


def driven(n: int) -> np.ndarray:
    t = 0.1 * np.arange(n)
    return np.clip(14 + 9 * np.sin(0.05 * t) + 4 * np.sin(0.31 * t), 0, None)


def mean_of(speeds: np.ndarray, cuts: tuple[int, ...] = ()) -> tuple[np.ndarray, np.ndarray, Wheels]:
    wheels = Wheels()
    parts = [wheels.mean(part, PLACES) for part in np.split(speeds, cuts, axis=1) if part.shape[1]]
    return np.concatenate([speed for speed, _ in parts]), np.concatenate([bad for _, bad in parts]), wheels


def test_wheels_that_differ_by_curves_and_slip_are_averaged_bit_by_bit():
    rng = np.random.default_rng(1)
    v = driven(3000)
    curve = np.outer([1, -1, 1, -1], np.sin(np.arange(3000) / 90)) * 1.8 * 5 / 2 / np.maximum(v, 8)  # 5 m/s^2
    speeds = v * (1 + 0.02 * rng.uniform(-1, 1, (4, 1))) + curve
    speeds[2, 500:510] *= 0.3  # locks for a second
    speed, undecided, wheels = mean_of(speeds)
    assert_array_equal(speed, speeds.sum(axis=0) / 4)
    assert not undecided.any()
    assert not wheels.refused


@pytest.mark.parametrize("value", [0.0, 11.0])
def test_a_wheel_that_stands_still_while_the_others_change_is_left_out(value):
    speeds = np.repeat(driven(3000)[None], 4, axis=0)
    speeds[1, 600:] = value
    speed, _, wheels = mean_of(speeds)
    assert np.isclose(speed, driven(3000))[700:].mean() > 0.99
    assert wheels.refused[f"wheel_speeds 2: {STANDS_STILL}"] > 2300


def test_a_wheel_in_another_unit_is_left_out_and_an_axle_is_not_told_from_the_other():
    v = driven(3000)
    speed, undecided, wheels = mean_of(np.array([v, v, v, v / 1.609]))
    assert np.isclose(speed, v).mean() > 0.95
    assert not undecided.any()
    assert wheels.refused[f"wheel_speeds 4: {DIFFERS}"] > 2800
    speed, undecided, wheels = mean_of(np.array([v, v, v / 1.609, v / 1.609]))
    assert undecided.mean() > 0.95
    assert np.isnan(speed[undecided]).all()
    assert wheels.refused[f"wheel_speeds: {UNDECIDED}"] == undecided.sum()


@pytest.mark.parametrize("scale", [0.8, 0.9, 1.1])
def test_a_wheel_of_another_size_is_left_out_from_the_first_fast_stretch_on(scale):
    v = driven(6000)
    speed, _, wheels = mean_of(np.array([v, scale * v, v, v]))
    assert_allclose(speed[1500:], v[1500:], rtol=1e-12)
    assert set(wheels.refused) == {f"wheel_speeds 2: {DIFFERS}"}


def test_two_dead_wheels_of_four_are_told():
    v = driven(3000)
    speed, _, _ = mean_of(np.array([0 * v, v, 0 * v, v]))
    assert np.isclose(speed, v).mean() > 0.98


def test_a_wheel_that_comes_back_is_used_again():
    v = driven(3000)
    dead = np.where(np.arange(3000) < 1500, 0.0, 1.02 * v)
    speed, _, _ = mean_of(np.array([v, v, v, dead]))
    assert_array_equal(speed[1600:], np.array([v, v, v, dead]).sum(axis=0)[1600:] / 4)


@given(
    st.lists(st.tuples(st.sampled_from(["sound", "dead", "scaled", "unknown"]), st.integers(0, 3)), max_size=3),
    st.lists(st.integers(0, 400), max_size=6),
)
@settings(deadline=None, max_examples=30)
def test_it_does_not_matter_how_rows_are_cut(faults, cuts):
    speeds = np.repeat(driven(400)[None], 4, axis=0)
    for i, (fault, wheel) in enumerate(faults):
        change = {"sound": 1.0, "dead": 0.0, "scaled": 1.7, "unknown": np.nan}[fault]
        speeds[wheel, 80 * i : 80 * i + 200] *= change
    whole, bad, wheels = mean_of(speeds)
    speed, undecided, other = mean_of(speeds, tuple(sorted(cuts)))
    assert_array_equal(speed, whole)
    assert_array_equal(undecided, bad)
    assert other.refused == wheels.refused


def conclude(folder: Path, change) -> tuple[Estimate, Pipeline]:
    """The estimate of a car on a level road, 25 min, after its four wheels (4, n) [m/s] are changed."""
    (folder / "car.dbc").write_text(DBC)
    database = cantools.database.load_file(folder / "car.dbc")
    n = 7500
    t = 0.2 * np.arange(n)
    v = np.clip(15 + 9 * np.sin(0.021 * t) + 5 * np.sin(0.17 * t) + 2 * np.sin(0.5 * t), 0.5, None)
    a = np.gradient(v, t)
    power = (MASS * a + 160 + 0.4 * v**2) * v
    wheels = change(np.repeat(v[None], 4, axis=0))
    names = [signal.name for signal in database.get_message_by_name("WHEELS").signals]
    frames = []
    for i in range(n):
        speeds = dict(zip(names, 3.6 * wheels[:, i], strict=True))
        engine = {"Power": power[i] / 1e3, "Brake": int(power[i] < -5e3)}
        for ident, values, late in ((256, speeds, 0.0), (257, engine, 0.01)):
            frames.append((t[i] + late, ident, database.encode_message(ident, values)))
    config = from_dict(
        {
            "bus": {"dbc": [str(folder / "car.dbc")]},
            "signals": {
                "wheel_speeds": [f"WHEELS.{name}" for name in names],
                "engine_power": "ENGINE.Power",
                "brake_switch": "ENGINE.Brake",
            },
            "prior": {"mass_kg": [500, 5000], "A_N": [0, 1000], "C_N_s2_m2": [0, 3]},
            "gate": {"interval_s": 3600, "acceleration_step_m_s2": 0.25, "relative_sd": [1.0, 3.0, 0.1]},
        }
    )
    pipeline = Pipeline(config)
    made = Frames.from_messages(
        can.Message(timestamp=at, arbitration_id=ident, data=payload, is_extended_id=False)
        for at, ident, payload in frames
    )
    return [*pipeline.feed(made), *pipeline.finish()][-1], pipeline


@pytest.mark.slow
def test_a_dead_wheel_does_not_change_the_mass_and_is_counted(tmp_path):
    final, pipeline = conclude(tmp_path, lambda wheels: wheels * np.array([[1.0], [1.0], [0.0], [1.0]]))
    assert final.mass is not None
    assert abs(final.mass.mean - MASS) < 4 * final.mass.sd
    assert pipeline.traffic.errors[f"wheel_speeds 3: {STANDS_STILL}"] > 10_000


@pytest.mark.slow
def test_an_axle_in_another_unit_withholds_the_estimate(tmp_path):
    final, _ = conclude(tmp_path, lambda wheels: wheels / np.array([[1.0], [1.0], [1.609], [1.609]]))
    assert final.status == Status.UNESTIMATED
    assert "wheel speeds contradict each other" in final.reason

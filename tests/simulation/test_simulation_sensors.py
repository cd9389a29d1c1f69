"""What the control units send of a drive: rates, noise, lag, resolution."""

import numpy as np
import pytest

from estimator.signals import DIMENSION, Role
from estimator.simulation.drive import drive
from estimator.simulation.effects.effect import Effect
from estimator.simulation.route import generate_route
from estimator.simulation.sensors import OPTIONAL, Sensors, measure
from estimator.simulation.truck import Truck
from estimator.simulation.truth import ORIGIN, Truth
from estimator.units import EARTH_RADIUS, STANDARD_GRAVITY

TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)
PERFECT = Sensors(speed_noise=0.0, torque_noise=0.0, torque_white_noise=0.0, torque_lag=0.0)


@pytest.fixture(scope="module")
def truth() -> Truth:
    rng = np.random.default_rng(11)
    return drive(TRUCK, generate_route("mixed", 20e3, rng), 600.0, rng)


def net_torque(signals):
    """Net torque [N.m] by J1939: indicated minus nominal friction, at the times of the indicated torque."""
    coarse, friction = signals[Role.TORQUE_FRACTION], signals[Role.FRICTION_FRACTION]
    fine = signals[Role.TORQUE_FRACTION_FINE].value if Role.TORQUE_FRACTION_FINE in signals else 0.0
    nominal = np.interp(coarse.t, friction.t, friction.value)
    return coarse.t, (coarse.value + fine - nominal) * signals[Role.REFERENCE_TORQUE].value[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("role", "period"),
    [
        (Role.SPEED, 0.1),
        (Role.WHEEL_SPEEDS, 0.1),
        (Role.TORQUE_FRACTION, 0.02),
        (Role.ENGINE_SPEED, 0.02),
        (Role.FRICTION_FRACTION, 0.25),
        (Role.REFERENCE_TORQUE, 5.0),
        (Role.GEAR, 0.1),
        (Role.SHIFT_IN_PROCESS, 0.02),
        (Role.AMBIENT_TEMPERATURE, 1.0),
        (Role.ALTITUDE, 1.0),
        (Role.GRADE, 0.1),
        (Role.HEADING, 1.0),
        (Role.FAN_SPEED, 1.0),
        (Role.YAW_RATE, 0.1),
    ],
)
def test_rates(truth, role, period):
    series = measure(truth, Sensors(), np.random.default_rng(0))[role]
    gaps = np.diff(series.t)

    assert np.all(gaps > 0.0)
    assert np.mean(gaps) == pytest.approx(period, rel=0.01)


def error_of_altitude(truth, **sensors):
    """Error of the altitude [m] (n,) at 1 Hz."""
    altitude = measure(truth, Sensors(altitude_noise=0.0, **sensors), np.random.default_rng(3))[Role.ALTITUDE]
    return altitude.value - np.interp(altitude.t, truth.t, truth.altitude)


def test_an_altimeter_wanders_slowly_and_is_noisy(truth):
    wander = error_of_altitude(truth, altitude_wander=5.0, altitude_wander_time=20.0)
    assert wander.std() == pytest.approx(5.0, rel=0.5)
    assert np.diff(wander).std() < 0.5
    white = error_of_altitude(truth, altitude_white_noise=2.0)
    assert white.std() == pytest.approx(2.0, rel=0.1)
    assert np.corrcoef(white[1:], white[:-1])[0, 1] == pytest.approx(0.0, abs=0.1)


@pytest.mark.slow
def test_a_gps_receiver_is_late_with_the_altitude():
    rng = np.random.default_rng(5)
    truth = drive(TRUCK, generate_route("highway", 20e3, rng, 0.03), 600.0, rng)
    sensors = Sensors(altitude_noise=0.0, altitude_smoothing=10.0)
    altitude = measure(truth, sensors, np.random.default_rng(0))[Role.ALTITUDE]
    at = altitude.t[60:]

    def away(late):
        return np.abs(altitude.value[60:] - np.interp(at - late, truth.t, truth.altitude)).mean()

    assert away(10.0) < 0.5 * away(0.0)


def test_grade_and_accelerometer_pitch_with_the_body(truth):
    plain, pitching = (
        measure(truth, Sensors(**more), np.random.default_rng(0))
        for more in ({}, {"body_pitch": 0.01, "accelerometer_offset": 0.2, "grade_white_noise": 1e-5})
    )
    a = np.interp(plain[Role.GRADE].t, truth.t, truth.a)
    assert np.polyfit(a, pitching[Role.GRADE].value - plain[Role.GRADE].value, 1)[0] == pytest.approx(0.01, rel=0.01)
    felt = [
        np.interp(plain[Role.GRADE].t, x.t, x.value)
        for x in (x[Role.LONGITUDINAL_ACCELERATION] for x in (plain, pitching))
    ]
    slope, offset = np.polyfit(a, felt[1] - felt[0], 1)
    assert slope == pytest.approx(0.01 * STANDARD_GRAVITY, rel=0.1)
    assert offset == pytest.approx(0.2, abs=0.01)


def test_every_role_is_known_and_finite(truth):
    for role, series in measure(truth, Sensors(), np.random.default_rng(0)).items():
        assert role in DIMENSION
        assert series.t.shape == series.value.shape
        assert np.all(np.isfinite(series.value))


def test_perfect_sensors_give_back_the_truth_within_their_resolution(truth):
    signals = measure(truth, PERFECT, np.random.default_rng(0))
    speed = signals[Role.SPEED]
    t, torque = net_torque(signals)
    # friction is sampled at 4 Hz in steps of 1 %: compare where the engine speed is steady
    steady = np.abs(np.interp(t, truth.t, np.gradient(truth.engine_speed, truth.t))) < 2.0

    np.testing.assert_allclose(speed.value, np.interp(speed.t, truth.t, truth.v), atol=0.51 / 256 / 3.6)
    error = np.abs(torque - np.interp(t, truth.t, truth.torque))[steady]
    assert np.mean(error < 0.0065 * 2500.0) > 0.995


def test_coarse_torque_comes_in_whole_percents_without_a_fine_part(truth):
    signals = measure(truth, Sensors(torque_resolution=0.01), np.random.default_rng(0))
    percents = 100.0 * signals[Role.TORQUE_FRACTION].value

    assert Role.TORQUE_FRACTION_FINE not in signals
    np.testing.assert_allclose(percents, np.round(percents), atol=1e-9)


def test_fine_torque_has_eight_steps(truth):
    fine = measure(truth, Sensors(), np.random.default_rng(0))[Role.TORQUE_FRACTION_FINE].value

    np.testing.assert_array_equal(np.unique(np.round(fine / 0.00125)), np.arange(8))


def test_speed_noise_is_white_and_of_the_asked_size(truth):
    speed = measure(truth, Sensors(speed_noise=0.03), np.random.default_rng(0))[Role.SPEED]
    v = np.interp(speed.t, truth.t, truth.v)
    error = (speed.value - v)[v > 1.0]

    assert np.std(error) == pytest.approx(0.03, rel=0.1)
    assert abs(np.corrcoef(error[1:], error[:-1])[0, 1]) < 0.06


def test_torque_noise_is_correlated_as_asked(truth):
    sensors = Sensors(torque_noise=0.02, torque_correlation=0.5, torque_white_noise=0.0)
    noisy = measure(truth, sensors, np.random.default_rng(0))
    clean = measure(truth, Sensors(torque_noise=0.0, torque_white_noise=0.0), np.random.default_rng(0))
    error = (net_torque(noisy)[1] - net_torque(clean)[1])[100:] / 2500.0

    assert np.std(error) == pytest.approx(0.02, rel=0.15)
    assert np.corrcoef(error[25:], error[:-25])[0, 1] == pytest.approx(np.exp(-1.0), abs=0.1)


def test_torque_is_late_by_its_lag(truth):
    late = Sensors(speed_noise=0.0, torque_noise=0.0, torque_white_noise=0.0, torque_lag=0.2, jitter=0.0)
    speed = measure(truth, late, np.random.default_rng(0))[Role.ENGINE_SPEED]

    np.testing.assert_allclose(speed.value, np.interp(speed.t - 0.2, truth.t, truth.engine_speed), atol=0.007)


def test_a_bus_can_lack_what_is_optional(truth):
    full = measure(truth, Sensors(), np.random.default_rng(0))
    bare = measure(truth, Sensors(without=frozenset(OPTIONAL)), np.random.default_rng(0))

    assert set(full) - set(bare) == set(OPTIONAL) - {Role.RETARDER_FRACTION}  # this truck has no retarder
    for role, series in bare.items():
        np.testing.assert_array_equal(series.value, full[role].value)


@pytest.mark.parametrize("dropouts", [0.0, 0.02])
def test_no_other_signal_depends_on_the_position(truth, dropouts):
    position = frozenset({Role.LATITUDE, Role.LONGITUDE})
    full, bare = (
        measure(truth, Sensors(dropouts=dropouts, without=without), np.random.default_rng(0))
        for without in (frozenset(), position)
    )

    assert set(full) - set(bare) == position
    for role, series in bare.items():
        np.testing.assert_array_equal(series.t, full[role].t)
        np.testing.assert_array_equal(series.value, full[role].value)


def test_positions_follow_the_way_with_errors_of_two_metres(truth):
    signals = measure(truth, Sensors(), np.random.default_rng(0))
    latitude, longitude = signals[Role.LATITUDE], signals[Role.LONGITUDE]
    scales = EARTH_RADIUS, EARTH_RADIUS * np.cos(ORIGIN[0])
    assert latitude.t is longitude.t
    for series, true, scale in zip((latitude, longitude), truth.position, scales, strict=True):
        error = (series.value - np.interp(series.t, truth.t, true)) * scale
        assert np.std(error) == pytest.approx(2.0, rel=0.2)
        assert abs(error.mean()) < 0.5
    steps = [np.diff(true) * scale for true, scale in zip(truth.position, scales, strict=True)]
    np.testing.assert_allclose(np.hypot(*steps), np.diff(truth.s), atol=1e-6)


@pytest.mark.slow
def test_motion_sensors_tell_bends_and_hills():
    rng = np.random.default_rng(5)
    truth = drive(TRUCK, generate_route("mixed", 20e3, rng, grade_sd=0.01), 600.0, rng)
    signals = measure(truth, Sensors(), np.random.default_rng(0))
    yaw, lateral = signals[Role.YAW_RATE], signals[Role.LATERAL_ACCELERATION]
    felt, heading = signals[Role.LONGITUDINAL_ACCELERATION], signals[Role.HEADING]
    v = np.interp(yaw.t, truth.t, truth.v)

    np.testing.assert_allclose(lateral.value, yaw.value * v, atol=0.3)
    # to the left is anticlockwise: the compass bearing falls
    turned = np.interp(heading.t[-1], truth.t, truth.heading) - np.interp(heading.t[0], truth.t, truth.heading)
    assert np.sum(yaw.value) * 0.1 == pytest.approx(-turned, abs=0.15)
    assert np.all((heading.value >= 0.0) & (heading.value < 2 * np.pi))
    gravity = felt.value - np.interp(felt.t, truth.t, truth.a)
    slope = np.interp(felt.t, truth.t, truth.grade)
    assert np.polyfit(slope, gravity, 1)[0] == pytest.approx(9.8, rel=0.05)


def test_grade_sensor_errs_as_asked(truth):
    grade = measure(truth, Sensors(grade_noise=0.003, grade_offset=0.01), np.random.default_rng(0))[Role.GRADE]

    assert np.mean(grade.value) == pytest.approx(0.01, abs=0.002)
    assert np.std(grade.value) == pytest.approx(0.003, rel=0.4)


def test_messages_drop_out_together_for_seconds(truth):
    signals = measure(truth, Sensors(dropouts=0.1), np.random.default_rng(0))
    torque, speed = signals[Role.TORQUE_FRACTION], signals[Role.SPEED]

    np.testing.assert_array_equal(torque.t, signals[Role.ENGINE_SPEED].t)
    assert 0.02 < 1.0 - len(torque.t) * 0.02 / truth.t[-1] < 0.25
    assert np.diff(speed.t).max() > 1.0
    assert np.diff(torque.t).max() > 1.0


@pytest.mark.slow
def test_retarder_torque_is_sent_where_there_is_a_retarder():
    rng = np.random.default_rng(11)
    route = generate_route("mixed", 20e3, rng)
    truth = drive(TRUCK, route, 600.0, rng, [Effect(name="retarder_use", magnitude=8000.0)])
    share = measure(truth, Sensors(), np.random.default_rng(0))[Role.RETARDER_FRACTION]
    working = np.interp(share.t, truth.t, truth.retarder) > 500.0

    assert share.value.min() == -1.0
    assert np.all(share.value[working] < 0.0)
    assert np.all(share.value <= 0.0)

"""The simulated truck obeys Newton, its driver the road, and its sensors what they are told."""

import numpy as np
import pytest

from estimator.signals import Role
from estimator.simulation.drive import drive
from estimator.simulation.driver import speeds_ahead
from estimator.simulation.moment import STEP
from estimator.simulation.recording import record
from estimator.simulation.route import Route, generate_route
from estimator.simulation.sensors import Sensors
from estimator.simulation.truck import Truck, draw_truck
from estimator.simulation.truth import Truth
from estimator.units import STANDARD_GRAVITY

TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)  # the dyno truth of the paper
WINDOW = 10  # steps of 0.1 s


def drive_mixed(seed: int, duration: float, grade_sd: float = 0.0) -> Truth:
    rng = np.random.default_rng(seed)
    route = generate_route("mixed", 25.0 * duration, rng, grade_sd)
    return drive(TRUCK, route, duration, rng)


@pytest.fixture(scope="module")
def flat() -> Truth:
    return drive_mixed(seed=1, duration=1200.0)


def driven(truth: Truth) -> np.ndarray:
    """Starts of windows of 0.1 s in which the engine alone pulls the truck or is dragged by it."""
    free = truth.engaged & ~truth.shifting & (truth.brake < 1.0)
    starts = np.arange(0, len(truth.t) - WINDOW, WINDOW)
    return starts[[free[i : i + WINDOW + 1].all() for i in starts]]


def over_windows(starts: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Trapezoidal means over windows."""
    window = values[starts[:, None] + np.arange(WINDOW + 1)]
    return (window.sum(axis=1) - 0.5 * (window[:, 0] + window[:, -1])) / WINDOW


def kinetic_power(truth: Truth, starts: np.ndarray) -> np.ndarray:
    v = truth.v
    return 0.5 * TRUCK.mass * (v[starts + WINDOW] ** 2 - v[starts] ** 2) / (WINDOW * STEP)


@pytest.mark.slow
def test_mean_engine_power_is_road_load_plus_kinetic_power(flat):
    starts = driven(flat)
    power = over_windows(starts, flat.power)
    load = over_windows(starts, TRUCK.A * flat.v + TRUCK.C * flat.v**3) + kinetic_power(flat, starts)

    assert len(starts) > 5000
    assert np.sqrt(np.mean((power - load) ** 2)) < 1e-3 * np.sqrt(np.mean(power**2))


@pytest.mark.slow
def test_newton_holds_at_every_step(flat):
    free = flat.engaged & ~flat.shifting
    tractive = flat.power[free] / flat.v[free] - flat.brake[free]
    resisting = TRUCK.A + TRUCK.C * flat.v[free] ** 2 + TRUCK.mass * flat.a[free]

    np.testing.assert_allclose(tractive, resisting, atol=1e-6 * TRUCK.mass)


@pytest.mark.slow
def test_energy_balances_on_a_hilly_road():
    truth = drive_mixed(seed=2, duration=600.0, grade_sd=0.015)
    starts = driven(truth)
    work = over_windows(starts, truth.power)
    spent = over_windows(starts, TRUCK.A * truth.v + TRUCK.C * truth.v**3) + kinetic_power(truth, starts)
    sine = truth.grade / np.hypot(1.0, truth.grade)
    climbing = TRUCK.mass * STANDARD_GRAVITY * over_windows(starts, sine * truth.v)

    assert np.sqrt(np.mean((work - spent - climbing) ** 2)) < 1e-3 * np.sqrt(np.mean(work**2))
    assert np.ptp(truth.altitude) > 5.0
    np.testing.assert_allclose(truth.altitude, np.cumsum(sine * truth.v) * STEP, atol=0.05)


def test_driveline_losses_are_paid_by_the_engine():
    truck = Truck(mass=20e3, A=1200.0, C=3.5, efficiency=0.95)
    rng = np.random.default_rng(4)
    truth = drive(truck, generate_route("highway", 10e3, rng), 300.0, rng)
    pulling = truth.engaged & ~truth.shifting & (truth.brake == 0.0) & (truth.torque > 50.0)
    wheel = (truck.A + truck.C * truth.v**2 + truck.mass * truth.a) * truth.v

    np.testing.assert_allclose(wheel[pulling], 0.95 * truth.power[pulling], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["urban", "mixed", "highway"])
def test_driver_keeps_to_the_speed_of_the_road(kind):
    rng = np.random.default_rng(7)
    route = generate_route(kind, 20e3, rng)
    truth = drive(draw_truck(rng), route, 600.0, rng)
    allowed = route.section_speed[np.searchsorted(route.section_start, truth.s, side="right") - 1]

    assert np.quantile(truth.v - allowed, 0.99) < 0.2
    assert np.max(truth.v - allowed) < 1.5
    assert truth.a.max() < 1.8
    assert truth.a.min() > -2.5
    assert truth.v.min() == 0.0


def test_truck_stops_short_of_stop_lines_dwells_and_stays_at_the_end():
    route = Route(
        section_start=np.array([0.0]),
        section_speed=np.array([14.0]),
        stop_position=np.array([400.0, 900.0]),
        stop_dwell=np.array([20.0, np.inf]),
        grade=np.zeros(60),
    )
    truth = drive(TRUCK, route, 240.0, np.random.default_rng(3))
    standing = truth.v == 0.0
    begins = np.flatnonzero(~standing[:-1] & standing[1:]) + 1

    np.testing.assert_allclose(truth.s[begins], [400.0, 900.0], atol=6.0)
    ends = np.flatnonzero(standing[:-1] & ~standing[1:]) + 1
    assert 20.0 <= (ends[1] - begins[0]) * STEP < 23.0
    assert standing[-1]


def test_speeds_ahead_fall_to_zero_at_a_stop_and_obey_the_deceleration():
    route = Route(
        section_start=np.array([0.0]),
        section_speed=np.array([20.0]),
        stop_position=np.array([500.0]),
        stop_dwell=np.array([np.inf]),
        grade=np.zeros(30),
    )
    seen = speeds_ahead(route, easing=0.2, stopping=0.5)

    assert seen[250] == 0.0
    assert seen[0] == 20.0
    assert seen[200] == pytest.approx(np.sqrt(2 * 0.5 * 100.0))


def test_shifts_interrupt_the_traction_for_about_a_second(flat):
    edges = np.flatnonzero(np.diff(flat.shifting.astype(int)))
    lengths = np.diff(edges)[::2] * STEP

    assert len(lengths) > 30
    assert lengths.max() < 1.25
    assert np.mean(lengths > 0.55) > 0.9  # hard braking cuts a few short
    assert np.all(flat.torque[~flat.engaged & flat.shifting] == 0.0)


def test_engine_stays_within_its_limits(flat):
    full = np.array([TRUCK.max_torque(w) for w in flat.engine_speed])

    assert np.all(flat.torque <= full + 0.08 * TRUCK.peak_torque)  # the turbo's lag behind a falling limit
    assert flat.engine_speed.min() > 0.9 * TRUCK.idle_speed
    assert flat.engine_speed.max() < TRUCK.max_speed


def test_fleet_is_class_8():
    rng = np.random.default_rng(5)
    fleet = [draw_truck(rng) for _ in range(300)]

    assert all(12e3 <= truck.mass <= 38e3 for truck in fleet)
    assert all(800.0 <= truck.A <= 2800.0 and 3.0 <= truck.C <= 4.3 for truck in fleet)


def test_same_seed_same_drive_and_other_sensors_do_not_change_it():
    route = generate_route("urban", 5e3, np.random.default_rng(0))
    first = record(TRUCK, route, 60.0, np.random.default_rng(9))
    again = record(TRUCK, route, 60.0, np.random.default_rng(9))
    noisy = record(TRUCK, route, 60.0, np.random.default_rng(9), sensors=Sensors(speed_noise=0.03))

    for role, series in first.signals.items():
        np.testing.assert_array_equal(series.value, again.signals[role].value)
    np.testing.assert_array_equal(first.truth.v, noisy.truth.v)
    assert not np.array_equal(first.signals[Role.SPEED].value, noisy.signals[Role.SPEED].value)

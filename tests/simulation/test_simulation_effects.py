"""Every effect acts on the simulated truck as physics says, and the books balance to the watt."""

from math import pi

import numpy as np
import pytest

from estimator.answers import simulation as answer
from estimator.errors import InputError
from estimator.report.simulation_summary import of_recording
from estimator.simulation.drive import drive
from estimator.simulation.effects.catalogue import KINDS, effects_from, parse_effect
from estimator.simulation.effects.effect import Effect
from estimator.simulation.effects.rolling import CRUISE, settled_excess, warm_up
from estimator.simulation.itinerary import Shape, plan_route
from estimator.simulation.moment import STEP, Moment, Scene
from estimator.simulation.recording import simulate
from estimator.simulation.route import RoadKind, Route, generate_route
from estimator.simulation.truck import Truck
from estimator.simulation.truth import Truth

pytestmark = pytest.mark.slow

TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)
GRAVITY = 9.80665


def drive_with(
    *effects: Effect | str, seed: int = 1, duration: float = 600.0, shape: Shape = "one-way", kind: RoadKind = "mixed"
) -> Truth:
    rng = np.random.default_rng(seed)
    route = plan_route(kind, duration, rng, shape)
    asked = [
        effect if isinstance(effect, Effect) else Effect(name=effect, magnitude=KINDS[effect].usual)
        for effect in effects
    ]
    return drive(TRUCK, route, duration, rng, asked)


def straight_road(length: float = 60e3, speed: float = 22.0, heading: float = 0.0) -> Route:
    return Route(
        section_start=np.array([0.0]),
        section_speed=np.array([speed]),
        stop_position=np.array([length]),
        stop_dwell=np.array([np.inf]),
        grade=np.zeros(int(length / 20.0) + 2),
        curvature=np.zeros(int(length / 5.0) + 2),
        start_heading=heading,
    )


@pytest.fixture(scope="module")
def plain() -> Truth:
    return drive_with()


def gap(truth: Truth) -> np.ndarray:
    """Power read beyond A v + C v^3 + m v a [W]."""
    read = truth.reading
    return read.power - TRUCK.A * read.v - TRUCK.C * read.v**3 - TRUCK.mass * read.v * read.a


def accounted(truth: Truth) -> np.ndarray:
    """What the effects add, and what is left of a pressed brake [W]."""
    return sum(truth.effect_power.values(), np.zeros(len(truth.t))) + truth.brake * truth.v


@pytest.mark.parametrize("name", KINDS)
def test_power_read_is_road_load_plus_what_the_effect_adds(name):
    end = 400.0 if name == "mass_step" else 240.0  # s; a load is taken on in minutes of standing
    effect = Effect(name=name, magnitude=KINDS[name].usual, start=50.0, end=end - 40.0)
    truth = drive_with(effect, seed=3, duration=end, kind="highway")
    free = truth.engaged & ~truth.shifting

    assert free.sum() > 5_000
    np.testing.assert_allclose(gap(truth)[free], accounted(truth)[free], atol=1e-4)
    assert truth.rms_power(name) > 5.0


@pytest.mark.parametrize("shape", ["one-way", "out-and-back", "loop"])
def test_the_books_balance_with_everything_at_once(shape):
    truth = drive_with(*KINDS, shape=shape, duration=240.0)
    free = truth.engaged & ~truth.shifting

    np.testing.assert_allclose(gap(truth)[free], accounted(truth)[free], atol=1e-4)
    assert set(truth.effect_power) == set(KINDS)


def test_without_effects_nothing_is_added(plain):
    assert plain.effect_power == {}
    assert plain.active == {}
    np.testing.assert_array_equal(plain.reading.power, plain.power)


def test_driveline_losses_are_accounted_for():
    truck = Truck(mass=20e3, A=1200.0, C=3.5, efficiency=0.95)
    rng = np.random.default_rng(4)
    truth = drive(
        truck, generate_route("highway", 10e3, rng), 300.0, rng, [Effect(name="auxiliary_load", magnitude=5e3)]
    )
    pulling = truth.driven & (truth.torque > 150.0)

    np.testing.assert_allclose(
        truth.effect_power["driveline_efficiency"][pulling], 0.05 * (truth.power[pulling] - 5e3), rtol=1e-9
    )


def test_one_more_effect_does_not_change_how_another_is_drawn():
    alone = drive_with("resistance_segment", "drafting")
    together = drive_with("resistance_segment", "drafting", "wind_gusts", "grade")

    assert alone.active == {name: together.active[name] for name in alone.active}


@pytest.mark.parametrize(
    ("name", "ratio"),
    [("torque_gain", lambda truth: truth.power), ("torque_bias", lambda truth: truth.engine_speed)],
)
def test_errors_of_the_torque_leave_the_drive_alone(plain, name, ratio):
    truth = drive_with(Effect(name=name, magnitude=0.05))

    np.testing.assert_array_equal(truth.v, plain.v)
    np.testing.assert_array_equal(truth.torque, plain.torque)
    np.testing.assert_allclose(truth.effect_power[name], 0.05 * ratio(plain), atol=1e-6)


def test_drift_grows_steadily_to_its_size(plain):
    truth = drive_with(Effect(name="sensor_drift", magnitude=0.1))

    np.testing.assert_allclose(truth.effect_power["sensor_drift"], 0.1 * plain.t / 600.0 * plain.power, atol=1e-6)


def test_late_torque_is_the_torque_of_before(plain):
    late = drive_with(Effect(name="time_lag", magnitude=0.5)).reading

    np.testing.assert_allclose(late.power[50:], plain.power[:-50], rtol=1e-9, atol=1e-6)


def test_speed_filter_has_its_time_constant(plain):
    read = drive_with(Effect(name="speed_filter", magnitude=0.4)).reading
    rising = np.diff(read.v) / 0.01

    np.testing.assert_allclose(rising, (plain.v - read.v)[1:] / 0.4, atol=0.02)


def test_wheel_speed_scale_touches_the_reading_only(plain):
    truth = drive_with(Effect(name="speed_scale", magnitude=0.02))

    np.testing.assert_allclose(truth.reading.v, 1.02 * plain.v)
    np.testing.assert_array_equal(truth.v, plain.v)


def test_quantised_torque_comes_in_steps():
    truth = drive_with(Effect(name="quantisation", magnitude=0.01))
    steps = truth.reading.power / truth.engine_speed / 25.0

    np.testing.assert_allclose(steps, np.round(steps), atol=1e-6)


@pytest.mark.parametrize(("from_where", "sign"), [(0.0, 1.0), (pi, -1.0)])
def test_wind_from_ahead_costs_and_from_behind_helps(from_where, sign):
    rng = np.random.default_rng(2)
    truth = drive(TRUCK, straight_road(), 400.0, rng, [Effect(name="headwind", magnitude=5.0, direction=from_where)])
    v = truth.v
    expected = TRUCK.C * ((v + sign * 5.0) * np.abs(v + sign * 5.0) - v * v) * v

    np.testing.assert_allclose(truth.effect_power["headwind"], expected, rtol=1e-6, atol=1.0)


def test_a_steady_wind_helps_on_the_way_back():
    rng = np.random.default_rng(2)
    route = plan_route("highway", 1200.0, rng, "out-and-back")
    truth = drive(
        TRUCK, route, 1200.0, rng, [Effect(name="headwind", magnitude=6.0, direction=float(route.heading[100]))]
    )
    quick = truth.v > 15.0
    turned = truth.s > route.length / 2
    per_meter = truth.effect_power["headwind"] / np.maximum(truth.v, 1.0)

    assert truth.s[-1] > 0.9 * route.length
    assert abs(per_meter[quick & ~turned].mean() - per_meter[quick & turned].mean()) > 200.0


def test_cold_tyres_roll_harder_until_rolling_has_warmed_them():
    truth = drive_with(Effect(name="warm_up", magnitude=0.3), duration=1500.0)
    rolling = truth.v > 2.0
    share = (truth.effect_power["warm_up"] / TRUCK.A)[rolling] / truth.v[rolling]

    assert share[0] == pytest.approx(0.3, abs=0.02)
    assert share[-1] < 0.4 * share[0]
    # while the truck stands the tyres cool again, so the next departure is a little harder
    assert np.max(np.diff(share)) > 0.0


def test_a_tyre_that_loses_air_rolls_harder_from_then_on():
    truth = drive_with(Effect(name="slow_puncture", magnitude=0.3, start=200.0))
    t, rolling = STEP * np.arange(len(truth.v)), truth.v > 2.0
    force = truth.effect_power["slow_puncture"][rolling] / truth.v[rolling]
    np.testing.assert_allclose(force, 0.3 * TRUCK.A * np.clip((t[rolling] - 200.0) / 400.0, 0.0, 1.0), atol=1.0)
    assert truth.active["slow_puncture"] == [(200.0, 600.0)]


@pytest.mark.parametrize("speed", [8.0, CRUISE])
def test_tyres_settle_at_the_temperature_of_a_steady_speed(speed):
    scene = Scene(truck=TRUCK, route=straight_road(), duration=0.0, rng=np.random.default_rng(1))
    rolling, now = warm_up(scene, Effect(name="warm_up", magnitude=0.3)).force, Moment(v=speed)
    assert rolling is not None
    for _ in range(round(6 * 3600 / STEP)):
        force = rolling(now)
    assert force == pytest.approx(TRUCK.A * settled_excess(0.3, speed), rel=1e-3, abs=1e-3 * TRUCK.A)
    assert settled_excess(0.3, CRUISE) == pytest.approx(-0.02, abs=0.03)
    assert settled_excess(0.0, speed) == 0.0


def test_mass_and_rolling_change_while_standing_at_a_stop():
    truth = drive_with(Effect(name="mass_step", magnitude=0.4, start=250.0))
    ((start, end),) = truth.active["mass_step"]
    k = round(start / 0.01)
    after = truth.driven & (truth.t > start)

    assert 100.0 < start < 400.0
    assert end == 600.0
    assert np.all(truth.v[k : k + 3000] == 0.0)
    assert np.all(truth.effect_power["mass_step"][:k] == 0.0)
    traction = truth.power[after] / truth.v[after] - TRUCK.C * truth.v[after] ** 2 - truth.brake[after]
    np.testing.assert_allclose(traction, 1.4 * (TRUCK.A + TRUCK.mass * truth.a[after]), atol=1.0)


def test_grade_is_weight_on_a_slope_and_uphill_air_is_thin():
    truth = drive_with(Effect(name="grade", magnitude=0.012))
    sine = truth.grade / np.hypot(1.0, truth.grade)

    np.testing.assert_allclose(truth.effect_power["grade"], TRUCK.mass * GRAVITY * sine * truth.v, rtol=1e-6, atol=0.1)
    high = truth.altitude > 5.0
    assert np.all(truth.effect_power["air_density"][high] <= 0.0)
    assert np.ptp(truth.pressure) > 100.0


def test_warmer_air_resists_less():
    truth = drive_with(Effect(name="air_density", magnitude=20.0))
    density = 288.15 / truth.ambient_temperature
    air = TRUCK.C * truth.v**3 * (density - 1.0)

    np.testing.assert_allclose(truth.effect_power["air_density"], air, atol=5.0)
    assert truth.ambient_temperature[-1] - truth.ambient_temperature[0] == pytest.approx(20.0, abs=4.0)


@pytest.mark.parametrize(("seed", "duration"), [(1, 1200.0), (3, 600.0)], ids=["by the coolant", "at random"])
def test_a_fan_takes_its_power_or_what_its_slip_takes_and_its_speed_tells(seed, duration):
    truth = drive_with(Effect(name="auxiliary_cycling", magnitude=30e3), seed=seed, duration=duration)
    power = truth.effect_power["auxiliary_cycling"]
    on = np.zeros(len(truth.t), bool)
    for start, end in truth.active["auxiliary_cycling"]:
        on |= (truth.t >= start - 1e-9) & (truth.t < end - 1e-9)

    np.testing.assert_allclose(np.unique(power.round(6)), [240.0, 30e3])
    assert np.mean(on == (power > 1e3)) > 0.999
    np.testing.assert_allclose(power, 30e3 * (truth.fan_speed / truth.fan_speed.max()) ** 3)


def test_engine_inertia_weighs_by_the_square_of_the_gearing():
    truth = drive_with(Effect(name="rotating_inertia", magnitude=5.0))
    gearing = np.array([0.0, *(TRUCK.gearing(gear) for gear in range(1, 13))])[truth.gear]
    closed = truth.engaged & ~truth.shifting

    expected = 5.0 * gearing**2 * truth.a * truth.v
    np.testing.assert_allclose(truth.effect_power["rotating_inertia"][closed], expected[closed], atol=1e-6)


def test_bends_cost_with_the_square_of_lateral_acceleration():
    truth = drive_with(Effect(name="cornering", magnitude=600.0))

    expected = 600.0 * truth.lateral_acceleration**2 * truth.v
    np.testing.assert_allclose(truth.effect_power["cornering"], expected, atol=1.0)
    assert np.abs(truth.lateral_acceleration).max() < 2.5


def test_slip_costs_with_the_square_of_tractive_force():
    truth = drive_with(Effect(name="load_loss", magnitude=0.02))
    free = truth.engaged & ~truth.shifting & (truth.v > 0.0)
    force = truth.power[free] / truth.v[free]

    np.testing.assert_allclose(
        truth.effect_power["load_loss"][free], 0.02 / 20e3 * force**2 * truth.v[free], rtol=1e-9, atol=1e-6
    )


@pytest.mark.parametrize(("name", "shown"), [("brake_use", False), ("brake_use_shown", True)])
def test_brake_drags_while_the_engine_pulls(name, shown):
    truth = drive_with(Effect(name=name, magnitude=3000.0))
    drags = truth.driven & (truth.effect_power[name] > 2900.0 * truth.v) & (truth.v > 4.0)

    assert drags.sum() > 1000
    assert np.mean(truth.power[drags] > 0.0) > 0.9
    assert np.mean(truth.braking[drags]) == pytest.approx(1.0 if shown else 0.0, abs=0.1)


def test_retarder_works_before_the_service_brake(plain):
    truth = drive_with(Effect(name="retarder_use", magnitude=8000.0))

    np.testing.assert_array_equal(truth.v, plain.v)
    np.testing.assert_allclose(truth.brake + truth.retarder, plain.brake)
    assert truth.retarder.max() <= 8000.0
    rolling = plain.v > 5.0
    assert 0 < truth.braking[rolling].sum() < 0.8 * plain.braking[rolling].sum()


def test_wet_road_is_where_it_is_asked_for():
    truth = drive_with(parse_effect("resistance_segment=0.3@200-500"))
    wet = (truth.t >= 200.0) & (truth.t < 500.0)

    np.testing.assert_allclose(truth.effect_power["resistance_segment"], np.where(wet, 0.3 * 1739.0, 0.0) * truth.v)
    assert truth.active == {"resistance_segment": [(200.0, 500.0)]}


def test_surging_liquid_swings_and_takes_no_power_in_the_long_run():
    truth = drive_with(Effect(name="liquid_surge", magnitude=0.3), duration=1200.0)
    power = truth.effect_power["liquid_surge"]
    rms = truth.rms_power("liquid_surge")

    assert rms > 2e3
    assert abs(power.mean()) < 0.1 * rms


def test_lane_by_lane_the_same_ground_on_the_way_back():
    truth = drive_with("road_surface", "grade", duration=900.0, shape="out-and-back")
    rng = np.random.default_rng(1)
    home = plan_route("mixed", 900.0, rng, "out-and-back").length
    out = (truth.s < home / 2 - 100.0) & (truth.v > 3.0)
    back = (truth.s > home / 2 + 100.0) & (truth.v > 3.0)
    force = truth.effect_power["road_surface"] / np.maximum(truth.v, 0.1)

    assert back.sum() > 20_000
    met_out = np.interp(home - truth.s[back], truth.s[out], force[out])
    np.testing.assert_allclose(force[back], met_out, atol=8.0)
    met_out = np.interp(home - truth.s[back], truth.s[out], truth.grade[out])
    np.testing.assert_allclose(truth.grade[back], -met_out, atol=5e-4)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("wind", ("'wind'", "did you mean headwind?")),
        ("headwind=strong", ("headwind=strong", "NAME=NUMBER")),
        ("grade=0.5", ("grade", "0.005 to 0.015")),
        ("time_lag=-0.1", ("time_lag", "-0.1")),
        ("grade=nan", ("grade", "nan")),
        ("resistance_segment@500-400", ("resistance_segment@500-400",)),
        ("grade=", ("'grade='", "NAME=NUMBER")),
        ("headwind@", ("'headwind@'", "NAME=NUMBER")),
        ("mass_step=0.3@500-", ("'mass_step=0.3@500-'", "NAME=NUMBER")),
    ],
)
def test_what_is_not_an_effect_is_refused_in_one_line(text, words):
    with pytest.raises(InputError) as error:
        drive_with(parse_effect(text), duration=1.0)

    assert "\n" not in str(error.value)
    assert all(word in str(error.value) for word in words)


def test_an_effect_twice_is_refused():
    with pytest.raises(InputError, match="twice"):
        drive_with("grade", "grade", duration=1.0)


def test_simulate_takes_names_and_magnitudes_and_describes_what_was_true():
    rng = np.random.default_rng(3)
    recording = simulate(
        TRUCK, "highway", 300.0, rng, effects={"grade": 0.01, "snow_plough": None}, shape="out-and-back"
    )
    said = of_recording(recording, "truck.blf", 1000, 300.0)

    assert said.truth == answer.Truth(mass_kg=27_190.0, A_N=1739.0, C_N_s2_m2=3.74)
    grade, plough = said.effects
    assert (grade.name, grade.known_as, grade.magnitude) == ("grade", "grade", 0.01)
    assert (plough.name, plough.known_as, plough.magnitude) == ("snow_plough", None, 3000.0)
    assert grade.rms_kW > 1.0
    assert set(said.also_acting_kW) == {"air_density"}


def test_usual_magnitudes_are_plausible_and_at_least_five_kinds_are_outside_the_catalogue():
    assert all(kind.low <= kind.usual <= kind.high and kind.summary for kind in KINDS.values())
    assert sum(kind.known_as is None for kind in KINDS.values()) >= 5
    assert [effect.magnitude for effect in effects_from({"headwind": None, "drafting": 0.2})] == [5.0, 0.2]

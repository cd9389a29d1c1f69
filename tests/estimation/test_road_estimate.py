"""A truck over hills that no signal shows, or that good and bad signals show: from CAN bytes to the estimate."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.config import J1939_BINDING, from_dict
from estimator.estimates import Estimate, Status
from estimator.estimation import road_inference
from estimator.report import summary
from estimator.report.parameter_text import road
from estimator.signals import Role, Series, Signals
from estimator.simulation.recording import Recording, record
from estimator.simulation.route import GRADE_SPACING, generate_route
from estimator.simulation.sensors import Sensors, measure
from estimator.simulation.truck import Truck
from estimator.streaming.listener import Listener
from estimator.streaming.pipeline import Pipeline

pytestmark = pytest.mark.slow

TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)  # the dyno truth of the paper
MINUTES = 30
CLIMB = frozenset({Role.ALTITUDE, Role.GRADE, Role.LONGITUDINAL_ACCELERATION})
WITH_GRADE = {**J1939_BINDING, "grade": "SSI.PitchAngle"}
ONCE = {"gate": {"interval_s": 60.0 * 60.0}}  # only the conclusion at the end


def over_hills(seed: int, **sensors) -> Recording:
    """Thirty minutes over slopes with a standard deviation of 1 %."""
    rng = np.random.default_rng(seed)
    road = generate_route("mixed", 1500.0 * MINUTES, rng, 0.01)
    return record(TRUCK, road, 60.0 * MINUTES, rng, sensors=Sensors(**sensors))


@pytest.fixture(scope="module")
def drive() -> Recording:
    return over_hills(2, altitude_noise=0.3)


def without(signals: Signals, roles: Iterable[Role]) -> dict[Role, Series]:
    return {role: series for role, series in signals.items() if role not in set(roles)}


def concluded(bus: Signals, **tables) -> Estimate:
    pipeline = Pipeline(from_dict(ONCE | tables))
    return [*pipeline.feed(frames_of(bus)), *pipeline.finish()][-1]


def away(estimate: Estimate) -> float:
    """How far the mass is from the truth, as a share of it."""
    assert estimate.status is Status.ESTIMATED, estimate.reason
    return abs(estimate.mass.mean / TRUCK.mass - 1)


def in_sds(estimate: Estimate) -> float:
    """The same in standard deviations."""
    return abs(estimate.mass.mean - TRUCK.mass) / estimate.mass.sd


@pytest.fixture(scope="module")
def hidden(drive) -> Estimate:
    return concluded(measure(drive.truth, Sensors(without=CLIMB), np.random.default_rng(5)))


# A road that no signal shows


@pytest.mark.nightly
def test_heavy_trucks_on_hilly_highways_are_as_far_off_as_they_say():
    """At a steady speed nearly all changes of the force are answers to slopes; one of three drives tells no mass."""
    truck = replace(TRUCK, mass=38e3)
    estimates = []
    for seed in (1, 2, 3):
        rng = np.random.default_rng(seed)
        road = generate_route("highway", 2000.0 * MINUTES, rng, 0.014)
        bus = record(truck, road, 60.0 * MINUTES, rng, sensors=Sensors(without=CLIMB)).signals
        estimates.append(concluded(bus))
    masses = [estimate.mass for estimate in estimates if estimate.mass is not None]
    assert len(masses) >= 2
    for mass in masses:
        assert abs(mass.mean / truck.mass - 1) < 0.05
        assert mass.q05 < truck.mass < mass.q95


def test_the_mass_is_known_although_nothing_shows_the_hills(hidden):
    assert away(hidden) < 0.02
    assert in_sds(hidden) < 2.58  # inside the 99 % interval
    assert hidden.mass.sd < 0.03 * TRUCK.mass


def test_what_the_hills_hide_is_withheld_with_a_reason_that_names_them(hidden):
    assert hidden.withheld
    assert set(hidden.withheld) <= {"A", "C"}
    for name, reason in hidden.withheld.items():
        assert hidden.marginals[name] is None
        assert "hills" in reason
        assert "altimeter" in reason


def test_the_slopes_of_the_hidden_road_are_told(hidden):
    assert hidden.road.slope_sd == pytest.approx(0.01, rel=0.3)
    assert hidden.road.shown_by == ()
    assert hidden.road.climbed is None


def test_the_summary_has_a_status_and_a_reason_for_every_parameter(hidden):
    told = summary.parameters(hidden)
    assert told.mass_kg.status == "estimated"
    assert told.mass_kg.mean == hidden.mass.mean
    for key, name in {"mass_kg": "m", "A_N": "A", "C_N_s2_m2": "C"}.items():
        parameter, is_known = getattr(told, key), hidden.marginals[name] is not None
        assert parameter.status == ("estimated" if is_known else "unestimated")
        assert parameter.reason == hidden.withheld.get(name, "")
        assert (parameter.q95 is None) == (not is_known)


def test_live_and_from_a_log_the_estimate_is_the_same_to_the_bit(drive):
    frames = frames_of(without(drive.signals, CLIMB))
    frames = frames[frames.t < frames.t[0] + 360]
    tables = {"gate": {"interval_s": 150.0, "minimum_samples": 300, "coverage": 0.0, "minimum_cells": 1}}
    tables["gate"]["relative_sd"] = [9, 9, 9]
    pipeline = Pipeline(from_dict(tables))
    at_once = [*pipeline.feed(frames), *pipeline.finish()]
    listener = Listener.of(from_dict(tables), send=lambda message: None)
    for message in frames.messages():
        listener.on_message_received(message)
    listener.stop()
    assert listener.latest == at_once[-1]
    assert at_once[-1].status is Status.ESTIMATED
    assert len(at_once) == 3


# A road that a signal shows


@pytest.fixture(scope="module")
def shown(drive) -> Estimate:
    return concluded(without(drive.signals, CLIMB - {Role.ALTITUDE}))


def test_a_good_altimeter_makes_all_three_known(shown, drive):
    assert away(shown) < 0.01
    assert in_sds(shown) < 4
    assert not shown.withheld
    assert abs(shown.A.mean - TRUCK.A) < 4 * shown.A.sd
    assert abs(shown.C.mean - TRUCK.C) < 4 * shown.C.sd
    assert shown.road.shown_by == ("altitude",)
    rise = np.diff(drive.truth.altitude)
    # What is climbed while the force is not known is not counted.
    assert 0.7 < shown.road.climbed / rise[rise > 0].sum() < 1.0


def test_a_good_altimeter_tells_more_than_none(shown, hidden):
    assert shown.mass.sd < 0.8 * hidden.mass.sd


def test_a_grade_on_the_bus_shows_the_road_too(drive):
    found = concluded(without(drive.signals, CLIMB - {Role.GRADE}), signals=WITH_GRADE)
    assert away(found) < 0.01
    assert set(found.withheld) <= {"A"}  # an offset of the grade and A are one
    assert abs(found.C.mean - TRUCK.C) < 4 * found.C.sd
    assert found.road.shown_by == ("grade",)


# Signals that are wrong


def stuck(series: Series) -> Series:
    """Its first value for ever."""
    return replace(series, value=np.full_like(series.value, series.value[0]))


def of_another_road(series: Series) -> Series:
    """The altitude of a vehicle elsewhere."""
    road = generate_route("mixed", 1500.0 * MINUTES, np.random.default_rng(99), 0.01)
    place = GRADE_SPACING * np.arange(len(road.grade))
    return replace(series, value=np.interp(15.0 * series.t, place, road.altitude))


def reversed_sign(series: Series) -> Series:
    return replace(series, value=-series.value)


def coming_and_going(series: Series) -> Series:
    """Two minutes there, three not."""
    there = series.t % 300 < 120
    return Series(series.t[there], series.value[there])


@pytest.mark.parametrize(
    ("role", "spoil"),
    [
        (Role.ALTITUDE, stuck),
        (Role.ALTITUDE, of_another_road),
        (Role.GRADE, reversed_sign),
        (Role.ALTITUDE, coming_and_going),
    ],
    ids=["altimeter stuck", "altitude of another vehicle", "grade with the wrong sign", "altitude comes and goes"],
)
def test_a_bad_signal_of_the_road_makes_no_wrong_mass(drive, role, spoil):
    signals = without(drive.signals, CLIMB - {role}) | {role: spoil(drive.signals[role])}
    found = concluded(signals, signals=WITH_GRADE)
    if found.status is Status.ESTIMATED:
        assert in_sds(found) < 4
        assert away(found) < 0.15
    else:
        assert found.mass is None
        assert found.reason


def smoothed(series: Series) -> Series:
    """As a receiver for satellites smooths it: without hills of less than two kilometres."""
    window = np.hanning(int(120.0 / np.median(np.diff(series.t))))
    even = np.convolve(np.pad(series.value, len(window), mode="edge"), window / window.sum(), "same")
    return replace(series, value=np.round(even[len(window) : -len(window)], 2))


def test_an_altitude_that_the_force_and_a_grade_contradict_is_left_out(drive):
    signals = without(drive.signals, {Role.LONGITUDINAL_ACCELERATION})
    right = concluded(signals, signals=WITH_GRADE)
    assert right.road.shown_by == ("altitude", "grade")
    assert right.road.contradicted == ()
    signals[Role.ALTITUDE] = smoothed(signals[Role.ALTITUDE])
    found = concluded(signals, signals=WITH_GRADE)
    alone = concluded(without(signals, {Role.ALTITUDE}), signals=WITH_GRADE)
    assert found.road.shown_by == ("grade",)
    assert found.road.contradicted == ("altitude",)
    assert found.mass == alone.mass
    assert away(found) < 0.01
    assert "shown by grade; altitude does not show it: without a change, of the wrong sign, or contradicted by" in road(
        summary.road(found)
    )


@pytest.mark.parametrize("role", [Role.ALTITUDE, Role.GRADE])
def test_a_signal_that_never_changes_does_not_make_the_hills_level(drive, role):
    constant = replace(drive.signals[role], value=np.zeros_like(drive.signals[role].value))
    signals = without(drive.signals, CLIMB)
    found, hidden = concluded(signals | {role: constant}, signals=WITH_GRADE), concluded(signals, signals=WITH_GRADE)
    assert found.road.shown_by == ()
    assert found.road.contradicted == (role.value,)
    assert (found.mass, found.A, found.C) == (hidden.mass, hidden.A, hidden.C)


def test_a_grade_with_the_wrong_sign_is_not_said_to_show_the_road():
    signals = without(over_hills(7).signals, CLIMB - {Role.GRADE})
    right = concluded(signals, signals=WITH_GRADE)
    assert (right.road.shown_by, right.road.contradicted) == (("grade",), ())
    found = concluded(signals | {Role.GRADE: reversed_sign(signals[Role.GRADE])}, signals=WITH_GRADE)
    assert away(found) < 0.02
    assert (found.road.shown_by, found.road.climbed, found.road.contradicted) == ((), None, ("grade",))
    assert "shown by no signal; grade does not show it: without a change, of the wrong sign, or" in road(
        summary.road(found)
    )


def test_by_the_force_alone_no_signal_is_left_out(drive):
    signals = without(drive.signals, CLIMB - {Role.ALTITUDE})
    found = concluded(signals | {Role.ALTITUDE: smoothed(signals[Role.ALTITUDE])})
    assert found.road.shown_by == ("altitude",)
    assert found.road.contradicted == ()


def test_a_late_torque_is_a_wrong_time_stamp_unless_the_configuration_expects_it(drive):
    late = measure(drive.truth, Sensors(without=CLIMB, torque_lag=0.55), np.random.default_rng(5))
    assert "+0.6 s apart: check their time stamps" in concluded(late).reason
    expected = concluded(late, kinematics={"maximum_lag_s": 2.0})
    assert away(expected) < 0.02
    assert in_sds(expected) < 2


def test_a_torque_that_drifts_is_withheld_because_parts_of_the_drive_contradict():
    rng = np.random.default_rng(4)
    road = generate_route("mixed", 1500.0 * 30, rng, 0.01)
    signals = dict(record(TRUCK, road, 1800.0, rng, sensors=Sensors(without=CLIMB, torque_resolution=0.01)).signals)
    torque, friction = signals[Role.TORQUE_FRACTION], signals[Role.FRICTION_FRACTION]
    lost = np.interp(torque.t, friction.t, friction.value)
    net = (torque.value - lost) * (1 + 0.3 * torque.t / 1800.0)
    signals[Role.TORQUE_FRACTION] = replace(torque, value=np.clip(np.round((net + lost) * 100) / 100, -1.25, 1.25))
    found = concluded(signals)
    assert found.status is Status.UNESTIMATED
    assert found.mass is None
    assert "two parts of the drive contradict each other" in found.reason
    assert found.remedy is not None
    assert found.remedy.startswith("give the logs of each load alone")  # a longer log has both


def test_over_hidden_hills_no_mass_is_given_where_most_of_the_driving_has_no_force(drive, monkeypatch):
    hidden = without(drive.signals, CLIMB)
    assert concluded(hidden).status is Status.ESTIMATED
    monkeypatch.setattr(road_inference, "MIN_DRIVEN", 0.999)
    found = concluded(hidden)
    assert (found.status, found.mass) == (Status.UNESTIMATED, None)
    assert found.reason.startswith("the vehicle pulls in ")
    assert found.reason.endswith(" that no signal shows are in the way, a longer drive or an altimeter would help")
    assert concluded(drive.signals).status is Status.ESTIMATED


def test_frames_of_a_drive_without_these_signals_carry_none_of_them(drive):
    frames: Frames = frames_of(without(drive.signals, CLIMB))
    pipeline = Pipeline(from_dict(ONCE))
    list(pipeline.feed(frames[frames.t < frames.t[0] + 60]))
    list(pipeline.finish())
    strides = pipeline.estimator.window.strides
    assert len(strides)
    for values in (strides.altitude, strides.grade, strides.gravity):
        assert np.isnan(values).all()

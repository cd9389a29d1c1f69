"""Readings at their senders' own times become rows of the grid, and friction comes back from its steps."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.samples import STEP, Rows
from estimator.settings import Vehicle
from estimator.signals import Role, Series
from estimator.streaming.alignment import Aligner
from estimator.streaming.engine_power import despike
from estimator.streaming.friction import FrictionCurve
from estimator.streaming.remarks import constant_friction
from estimator.streaming.resampling import cell_means

REFERENCE = 2500.0  # N.m
SPEED_AND_POWER = frozenset({Role.SPEED, Role.ENGINE_POWER})


def every(period: float, start: float, end: float, value, phase: float = 0.0) -> Series:
    t = np.arange(start + phase, end, period)
    return Series(t, np.broadcast_to(np.asarray(value(t) if callable(value) else value, dtype=float), t.shape).copy())


def rows_of(readings: dict[Role, Series], vehicle: Vehicle | None = None, bound=None, end: float = 20.0) -> Rows:
    aligner = Aligner(vehicle or Vehicle(), frozenset(readings) if bound is None else bound)
    lists = {role: [series] for role, series in readings.items()}
    parts = [*aligner.feed(lists, end), *aligner.finish(end)]
    rows = parts[0]
    for part in parts[1:]:
        rows = Rows.concatenate(rows, part)
    return rows


# The straight lines and their means


def integrated(t, value, low: float, high: float) -> float:
    """Mean of the straight lines over [low, high], exact: trapezes between all kinks inside."""
    kinks = np.concatenate([[low], t[(t > low) & (t < high)], [high]])
    return float(np.trapezoid(np.interp(kinks, t, value), kinks)) / (high - low)


times = st.lists(st.floats(0.011, 0.9), min_size=1, max_size=40).map(lambda gaps: 0.0137 + np.cumsum([0.0, *gaps]))


@pytest.mark.slow
@given(times, st.randoms(use_true_random=False), st.floats(0.05, 1.0))
def test_cell_means_integrate_the_straight_lines(t, random, limit):
    value = np.array([random.uniform(-50, 50) for _ in t])
    for i in range(len(t)):
        if random.random() < 0.1:
            value[i] = np.nan
    edges = (np.arange(-3, int(t[-1] / STEP) + 4) - 0.5) * STEP
    mean, there = cell_means(t, value, edges, limit)
    width = np.diff(t)
    for low, high, m, present in zip(edges[:-1], edges[1:], mean, there, strict=True):
        lines = (t[:-1] < high) & (t[1:] > low)
        covered = t[0] <= low and high <= t[-1]
        assert present == (covered and bool(np.all(width[lines] <= limit)))
        if present and np.all(np.isfinite(value[:-1][lines] + value[1:][lines])):
            assert m == pytest.approx(integrated(t, value, low, high), abs=1e-9)
        else:
            assert np.isnan(m)


def test_cell_means_need_two_readings():
    edges = np.arange(4) * STEP
    for t in (np.empty(0), np.array([0.1])):
        mean, there = cell_means(t, np.ones(len(t)), edges, 1.0)
        assert np.isnan(mean).all()
        assert not there.any()


def test_cell_means_are_right_at_the_times_of_real_clocks():
    """1.7e9 s leaves 0.2 microseconds of resolution."""
    t = 1.7e9 + np.arange(0, 10, 0.1)
    edges = (np.arange(round(1.7e9 / STEP) + 5, round(1.7e9 / STEP) + 90) - 0.5) * STEP
    mean, there = cell_means(t, 20 + 0.5 * (t - 1.7e9), edges, 0.3)
    assert there.all()
    np.testing.assert_allclose(mean, 20 + 0.5 * ((edges[1:] + edges[:-1]) / 2 - 1.7e9), atol=2e-4)


# Gaps and values that are not available


def test_a_gap_longer_than_three_periods_is_not_bridged():
    speed = every(0.1, 0, 20, 15.0)
    keep = (speed.t < 8.0) | (speed.t > 8.44)
    rows = rows_of({Role.SPEED: Series(speed.t[keep], speed.value[keep]), Role.ENGINE_POWER: every(0.02, 0, 20, 1e5)})
    gone = (rows.t > 7.9) & (rows.t < 8.5 - 1e-6)
    assert np.isnan(rows.speed[gone]).all()
    assert not rows.fresh[gone, 0].any()
    assert rows.fresh[gone, 1].all()
    inside = ((rows.t < 7.85) | (rows.t > 8.65)) & (rows.t > 0.1) & (rows.t < 19.8)
    np.testing.assert_allclose(rows.speed[inside], 15.0)
    np.testing.assert_allclose(rows.power[inside], 1e5)


def test_a_gap_of_two_periods_is_bridged():
    speed = every(0.1, 0, 20, lambda t: t)
    keep = np.abs(speed.t - 8.0) > 0.05
    rows = rows_of({Role.SPEED: Series(speed.t[keep], speed.value[keep]), Role.ENGINE_POWER: every(0.02, 0, 20, 1e5)})
    inside = (rows.t > 0.1) & (rows.t < 19.8)
    np.testing.assert_allclose(rows.speed[inside], rows.t[inside])


def test_not_available_is_unknown_but_fresh():
    speed = every(0.1, 0, 20, 15.0)
    speed.value[80:90] = np.nan
    rows = rows_of({Role.SPEED: speed, Role.ENGINE_POWER: every(0.02, 0, 20, 1e5)})
    inside = (rows.t > 0.1) & (rows.t < 19.8)
    assert rows.fresh[inside].all()
    assert np.isnan(rows.speed[(rows.t > 7.95) & (rows.t < 8.95)]).all()
    assert np.isfinite(rows.speed[inside & ((rows.t < 7.85) | (rows.t > 9.05))]).all()


def test_context_is_held_while_fresh_and_then_unknown():
    readings = {
        Role.SPEED: every(0.1, 0, 20, 15.0),
        Role.ENGINE_POWER: every(0.02, 0, 20, 1e5),
        Role.GEAR: every(0.2, 0, 10, lambda t: np.floor(t)),
    }
    rows = rows_of(readings)
    gear = rows.context[Role.GEAR]
    early, late = (rows.t > 0.3) & (rows.t < 9.7), rows.t > 9.8 + 0.6 + 0.01
    np.testing.assert_array_equal(gear[early], np.floor(np.floor(rows.t[early] / 0.2 + 1e-9) * 0.2 + 1e-9))
    assert np.isnan(gear[late]).all()


def test_readings_out_of_order_or_twice_are_dropped():
    speed = every(0.1, 0, 20, 15.0)
    order = np.arange(len(speed.t))
    order[[50, 51]] = order[[51, 50]]
    shuffled = Series(np.repeat(speed.t[order], 2), np.tile([15.0, 99.0], len(order)))
    rows = rows_of({Role.SPEED: shuffled, Role.ENGINE_POWER: every(0.02, 0, 20, 1e5)})
    inside = (rows.t > 0.1) & (rows.t < 19.8)
    np.testing.assert_allclose(rows.speed[inside], 15.0)


def test_speed_is_the_mean_of_the_wheels_where_there_is_no_speed():
    aligner = Aligner(Vehicle(), frozenset({Role.WHEEL_SPEEDS, Role.ENGINE_POWER}))
    wheels = [every(0.1, 0, 20, 14.4), every(0.1, 0, 20, 15.6, phase=0.03)]
    rows = next(aligner.feed({Role.WHEEL_SPEEDS: wheels, Role.ENGINE_POWER: [every(0.02, 0, 20, 1e5)]}, 20.0))
    np.testing.assert_allclose(rows.speed[2:], 15.0)


# Batches


def cut(readings: dict[Role, Series], low: float, high: float) -> dict[Role, list[Series]]:
    out = {}
    for role, series in readings.items():
        part = (series.t >= low) & (series.t < high)
        if part.any():
            out[role] = [Series(series.t[part], series.value[part])]
    return out


def jittered(period: float, end: float, rng, value) -> Series:
    t = np.arange(rng.uniform(0, period), end, period)
    t = t + rng.uniform(-0.1, 0.1, len(t)) * period
    return Series(t, value(t))


@pytest.mark.slow
@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1))
def test_rows_do_not_depend_on_how_readings_were_cut(seed):
    rng = np.random.default_rng(seed)
    end = 40.0
    readings = {
        Role.SPEED: jittered(0.1, end, rng, lambda t: 15 + 3 * np.sin(t / 3)),
        Role.ENGINE_SPEED: jittered(0.02, end, rng, lambda t: 120 + 10 * np.sin(t / 3)),
        Role.TORQUE_FRACTION: jittered(0.02, end, rng, lambda t: 0.4 + 0.2 * np.sin(t)),
        Role.REFERENCE_TORQUE: jittered(5.0, end, rng, lambda t: np.full(len(t), REFERENCE)),
        Role.GEAR: jittered(0.1, end, rng, lambda t: np.floor(t / 5)),
    }
    nows = np.arange(5.0, end + 0.1, 5.0)

    def run(pieces: int) -> Rows:
        aligner, parts, last = Aligner(Vehicle(), frozenset(readings)), [], 0.0
        for now in nows:
            cuts = np.concatenate([[last], np.sort(rng.uniform(last, now, pieces - 1)), [now]])
            for low, high in pairwise(cuts.tolist()):
                # Readings of the first seconds settle how long each signal stays fresh.
                whole = now == nows[0]
                parts += aligner.feed(cut(readings, last if whole else low, now if whole else high), high)
            last = now
        parts += aligner.finish(end)
        rows = parts[0]
        for part in parts[1:]:
            rows = Rows.concatenate(rows, part)
        return rows

    whole, pieces = run(1), run(4)
    np.testing.assert_array_equal(whole.index, pieces.index)
    np.testing.assert_array_equal(whole.fresh, pieces.fresh)
    np.testing.assert_allclose(whole.speed, pieces.speed, rtol=1e-12)
    np.testing.assert_allclose(whole.power, pieces.power, rtol=1e-9)
    np.testing.assert_array_equal(whole.context[Role.GEAR], pieces.context[Role.GEAR])
    np.testing.assert_array_equal(np.diff(whole.index), 1)
    assert np.isfinite(whole.power).sum() > 300


def test_the_memory_of_the_aligner_is_bounded():
    aligner = Aligner(Vehicle(), SPEED_AND_POWER)
    for k in range(200):
        low, high = 5.0 * k, 5.0 * (k + 1)
        list(
            aligner.feed(
                {Role.SPEED: [every(0.1, low, high, 9.0)], Role.ENGINE_POWER: [every(0.02, low, high, 1.0)]}, high
            )
        )
    assert all(len(track.t) < 1000 for track in [*aligner._tracks.values(), aligner._engine.track])


# Power

W, F, FINE, FRICTION, PARASITIC = 130.0, 0.5, 0.0075, 0.08, 0.02


def powertrain(*roles: Role) -> dict[Role, Series]:
    value = {
        Role.ENGINE_POWER: 123e3,
        Role.ENGINE_TORQUE: 900.0,
        Role.ENGINE_SPEED: W,
        Role.TORQUE_FRACTION: F,
        Role.TORQUE_FRACTION_FINE: FINE,
        Role.FRICTION_FRACTION: FRICTION,
        Role.PARASITIC_FRACTION: PARASITIC,
        Role.REFERENCE_TORQUE: REFERENCE,
        Role.BATTERY_VOLTAGE: 380.0,
        Role.BATTERY_CURRENT: 60.0,
    }
    period = {Role.FRICTION_FRACTION: 0.25, Role.PARASITIC_FRACTION: 0.25, Role.REFERENCE_TORQUE: 5.0}
    readings = {role: every(period.get(role, 0.02), 0, 20, value[role]) for role in roles}
    return {Role.SPEED: every(0.1, 0, 20, 20.0), **readings}


PERCENT = (Role.ENGINE_SPEED, Role.TORQUE_FRACTION)
FORMULAS = {
    "power": ((Role.ENGINE_POWER,), {}, 123e3),
    "power before torque": ((Role.ENGINE_POWER, *PERCENT, Role.REFERENCE_TORQUE), {}, 123e3),
    "torque": ((Role.ENGINE_TORQUE, Role.ENGINE_SPEED), {}, 900 * W),
    "percent": ((*PERCENT, Role.REFERENCE_TORQUE), {}, F * REFERENCE * W),
    "fine": ((*PERCENT, Role.TORQUE_FRACTION_FINE, Role.REFERENCE_TORQUE), {}, (F + FINE) * REFERENCE * W),
    "friction": ((*PERCENT, Role.FRICTION_FRACTION, Role.REFERENCE_TORQUE), {}, (F - FRICTION) * REFERENCE * W),
    "parasitic ignored": ((*PERCENT, Role.PARASITIC_FRACTION, Role.REFERENCE_TORQUE), {}, F * REFERENCE * W),
    "parasitic": (
        (*PERCENT, Role.FRICTION_FRACTION, Role.PARASITIC_FRACTION, Role.REFERENCE_TORQUE),
        {"subtract_parasitic_losses": True},
        (F - FRICTION - PARASITIC) * REFERENCE * W,
    ),
    "reference of the configuration": (PERCENT, {"reference_torque_Nm": 2000.0}, F * 2000 * W),
    "configuration before bus": ((*PERCENT, Role.REFERENCE_TORQUE), {"reference_torque_Nm": 2000.0}, F * 2000 * W),
    "battery": ((Role.BATTERY_CURRENT, Role.BATTERY_VOLTAGE), {}, 380.0 * 60.0),
    "battery, the other sign": (
        (Role.BATTERY_CURRENT, Role.BATTERY_VOLTAGE),
        {"discharge_current": "negative"},
        -380.0 * 60.0,
    ),
    "torque before battery": (
        (Role.BATTERY_CURRENT, Role.BATTERY_VOLTAGE, Role.ENGINE_TORQUE, Role.ENGINE_SPEED),
        {},
        900 * W,
    ),
    "battery before percent": (
        (Role.BATTERY_CURRENT, Role.BATTERY_VOLTAGE, *PERCENT, Role.REFERENCE_TORQUE),
        {},
        380.0 * 60.0,
    ),
    "efficiency": ((Role.ENGINE_POWER,), {"driveline_efficiency": 0.95}, 0.95 * 123e3),
    "efficiency of torque": ((Role.ENGINE_TORQUE, Role.ENGINE_SPEED), {"driveline_efficiency": 0.9}, 0.9 * 900 * W),
}


@pytest.mark.parametrize("name", FORMULAS)
def test_power(name):
    roles, vehicle, power = FORMULAS[name]
    rows = rows_of(powertrain(*roles), Vehicle(**vehicle))
    inside = (rows.t > 0.1) & (rows.t < 19.8)
    np.testing.assert_allclose(rows.power[inside], power, rtol=1e-9)


@pytest.mark.parametrize(
    ("missing", "vehicle"),
    [
        (Role.FRICTION_FRACTION, {}),
        (Role.REFERENCE_TORQUE, {}),
        (Role.ENGINE_SPEED, {}),
        (Role.PARASITIC_FRACTION, {"subtract_parasitic_losses": True}),
    ],
)
def test_a_term_that_is_expected_but_absent_makes_power_unknown(missing, vehicle):
    readings = powertrain(*PERCENT, Role.FRICTION_FRACTION, Role.PARASITIC_FRACTION, Role.REFERENCE_TORQUE)
    bound = frozenset(readings)
    del readings[missing]
    assert np.isnan(rows_of(readings, Vehicle(**vehicle), bound).power).all()


def test_power_is_unknown_while_friction_is_stale():
    readings = powertrain(*PERCENT, Role.FRICTION_FRACTION, Role.REFERENCE_TORQUE)
    readings[Role.FRICTION_FRACTION] = every(0.25, 0, 10, FRICTION)
    rows = rows_of(readings)
    assert np.isfinite(rows.power[(rows.t > 0.1) & (rows.t < 10.3)]).all()
    assert np.isnan(rows.power[rows.t > 10.7]).all()


def test_the_reference_torque_holds_once_heard():
    readings = powertrain(*PERCENT, Role.REFERENCE_TORQUE)
    readings[Role.REFERENCE_TORQUE] = Series(np.array([2.0]), np.array([REFERENCE]))
    rows = rows_of(readings)
    assert np.isnan(rows.power[rows.t < 1.9]).all()
    np.testing.assert_allclose(rows.power[(rows.t > 2.1) & (rows.t < 19.8)], F * REFERENCE * W)


def test_speed_and_power_get_the_same_low_pass():
    """An oscillation comes out damped alike, at senders' rates of 10 and 50 Hz."""
    wave = lambda t: 20 + np.sin(2 * np.pi * 0.5 * t)  # noqa: E731
    rows = rows_of({Role.SPEED: every(0.1, 0, 20, wave, 0.04), Role.ENGINE_POWER: every(0.02, 0, 20, wave)})
    inside = (rows.t > 0.2) & (rows.t < 19.8)
    np.testing.assert_allclose(rows.speed[inside], rows.power[inside], atol=0.015)


# Friction


def smooth_friction(w):
    return (95.0 + 0.25 * w + 0.0024 * w**2) / REFERENCE


def in_batches(curve: FrictionCurve, w, reading) -> np.ndarray:
    return np.concatenate(
        [
            curve.refine(w[i : i + 250], reading[i : i + 250], w[i : i + 250], np.array([0, 250]))
            for i in range(0, len(w), 250)
        ]
    )


@pytest.mark.parametrize("seed", range(3))
def test_friction_comes_back_from_whole_percents(seed):
    rng = np.random.default_rng(seed)
    gears = np.arange(12_000) % 1500 / 1500
    w = 100 + 60 * gears + 10 * np.sin(np.arange(12_000) / 170 + rng.uniform(0, 6)) + rng.normal(0, 0.1, 12_000)
    reading = np.round(smooth_friction(w), 2)
    refined = in_batches(FrictionCurve(), w, reading)
    assert np.sqrt(np.mean((refined - smooth_friction(w))[6000:] ** 2)) < 0.1 * 0.01
    assert np.abs(refined - reading)[500:].max() <= 0.005 + 1e-9


def test_a_long_cruise_does_not_draw_friction_to_its_rounded_reading():
    w = np.concatenate([130 + 45 * np.sin(np.arange(6000) / 200), 121 + 2 * np.sin(np.arange(30_000) / 500)])
    reading = np.round(smooth_friction(w), 2)
    refined = in_batches(FrictionCurve(), w, reading)
    assert abs(np.mean((reading - smooth_friction(w))[-20_000:])) > 0.3 * 0.01
    assert abs(np.mean((refined - smooth_friction(w))[-20_000:])) < 0.05 * 0.01


def test_friction_that_jumps_stays_within_half_a_step_of_its_readings():
    rng = np.random.default_rng(3)
    w = 130 + 40 * np.sin(np.arange(10_000) / 300)
    reading = np.round(smooth_friction(w) + 0.03 * (rng.random(10_000 // 500).repeat(500) > 0.5), 2)
    refined = in_batches(FrictionCurve(), w, reading)
    assert np.abs(refined - reading)[500:].max() <= 0.005 + 1e-9


def test_friction_that_is_the_same_at_all_engine_speeds_is_told():
    """A sender that repeats its first value: A of a truck was 67 % too large."""
    w = 120 + 55 * np.sin(np.arange(10_000) / 300)
    stuck, sound = FrictionCurve(), FrictionCurve()
    in_batches(stuck, w, np.full(10_000, 0.06))
    in_batches(sound, w, np.round(smooth_friction(w), 2))
    assert constant_friction(sound.constant, {}) == []
    (line,) = constant_friction(stuck.constant, {Role.FRICTION_FRACTION: "EEC3.Friction"})
    assert line.startswith("EEC3.Friction (friction_fraction) is 6 % at all engine speeds from 6")
    cruise = FrictionCurve()
    in_batches(cruise, np.full(1000, 120.0), np.full(1000, 0.06))
    assert cruise.constant is None


def test_friction_at_one_speed_is_the_reading():
    refined = in_batches(FrictionCurve(), np.full(1000, 120.0), np.full(1000, 0.06))
    np.testing.assert_array_equal(refined, 0.06)


def test_friction_is_unknown_where_speed_or_reading_is():
    w = 130 + 40 * np.sin(np.arange(1000) / 300)
    reading = np.round(smooth_friction(w), 2)
    w[100:200], reading[300:400] = np.nan, np.nan
    refined = FrictionCurve().refine(w, reading, w, np.array([0, 1000]))
    np.testing.assert_array_equal(np.isnan(refined), np.isnan(w) | np.isnan(reading))
    none = FrictionCurve().refine(np.full(5, np.nan), np.full(5, 0.05), np.full(5, 90.0), np.array([0, 5]))
    assert np.isnan(none).all()


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1))
def test_friction_of_many_batches_is_that_of_one_after_the_other(seed):
    rng = np.random.default_rng(seed)
    w = 130 + 40 * np.sin(np.arange(2000) / 300)
    reading = np.where(rng.random(2000) < 0.1, np.nan, np.round(smooth_friction(w), 2))
    bounds = np.array([0, *np.sort(rng.integers(0, 2000, 12)), 2000])
    one, many = FrictionCurve(), FrictionCurve()
    parts = [
        one.refine(w[low:high], reading[low:high], w[low:high], np.array([0, high - low]))
        for low, high in pairwise(bounds.tolist())
    ]
    np.testing.assert_array_equal(many.refine(w, reading, w, bounds), np.concatenate(parts))


def test_lone_gross_errors_are_repaired_and_nothing_else():
    rng = np.random.default_rng(3)
    whole = np.array([0, 500])
    t = np.arange(500) / 50
    clean = 2e5 + 1e5 * np.sin(t) + 2e3 * rng.standard_normal(500)
    clean[250:] -= 2e5  # a gear change
    assert np.abs(despike(clean, whole) - clean).max() == 0
    dirty = clean.copy()
    bad = rng.choice(np.arange(5, 495, 7), 15, replace=False)
    dirty[bad] += rng.choice([-1, 1], 15) * 3e5
    repaired = despike(dirty, whole)
    assert np.abs(repaired - clean)[bad].max() < 5e4
    assert np.array_equal(np.delete(repaired, bad), np.delete(clean, bad))
    unknown = clean.copy()
    unknown[::3] = np.nan
    assert np.array_equal(np.isnan(despike(unknown, whole)), np.isnan(unknown))


@pytest.mark.slow
@given(st.integers(0, 2**32 - 1))
def test_errors_of_power_are_judged_in_their_own_block(seed):
    rng = np.random.default_rng(seed)
    value = 2e5 + 1e5 * np.sin(np.arange(300) / 40) + 2e3 * rng.standard_normal(300)
    value[rng.random(300) < 0.03] += 3e5
    value[rng.random(300) < 0.03] = np.nan
    bounds = np.array([0, *np.sort(rng.integers(0, 300, 6)), 300])
    parts = [despike(value[low:high], np.array([0, high - low])) for low, high in pairwise(bounds.tolist())]
    np.testing.assert_array_equal(despike(value, bounds), np.concatenate(parts))

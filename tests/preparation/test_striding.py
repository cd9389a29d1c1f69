"""Strides from rows: the same however rows are batched, every row counted once, and right where the truth is known."""

from collections import Counter
from dataclasses import fields
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from estimator.config import Config
from estimator.errors import StateError
from estimator.preparation.admission import UNSEEN_MARGIN, Reason
from estimator.preparation.standstill import Standstill
from estimator.preparation.striding import GAP_DISTANCE, Strider
from estimator.samples import STEP, Rows
from estimator.settings import Admission, Load
from estimator.signals import Quantity, Role
from estimator.strides import EDGE, LAGS, ROWS, Strides

MASS = 20_000.0
WANTED = frozenset({Quantity.ENGINE_SPEED})


def rows_of(speed, power, first=0, **context) -> Rows:
    """Rows with fresh readings wherever there is a value."""
    n = len(speed)
    power = np.broadcast_to(np.asarray(power, float), n).copy()
    told = {role: np.broadcast_to(np.asarray(values, float), n).copy() for role, values in context.items()}
    fresh = np.isfinite(np.column_stack([speed, power]))
    return Rows(
        index=np.arange(first, first + n), speed=np.asarray(speed, float), power=power, fresh=fresh, context=told
    )


def strided(rows: Rows, cuts=(), wanted=WANTED) -> tuple[Strides, Counter[str]]:
    rejected: Counter[str] = Counter()
    strider = Strider(Admission(), wanted, 0.0)
    parts = [strider.feed(rows[a:b], rejected) for a, b in pairwise([0, *sorted(cuts), len(rows)]) if b > a]
    return Strides.concatenate([*parts, strider.finish(rejected)]), rejected


def known(strides: Strides) -> Strides:
    """All but the last rows, which no stride can be computed from, must be known."""
    assert strides.known[:-1].all()
    return strides[strides.known]


def pull(seconds=60.0, force=12_000.0, v0=8.0) -> Rows:
    """A constant force on a mass, on a flat road without resistance."""
    t = STEP * np.arange(round(seconds / STEP))
    v = v0 + force / MASS * t
    return rows_of(v, force * v)


def messy(seed: int, n: int = 500) -> Rows:
    """Driving and standing, with braking, shifts, coasting, silence of either signal and jumps of the speed."""
    rng = np.random.default_rng(seed)
    a = np.repeat(rng.normal(0, 0.5, n // 50 + 1), 50)[:n]
    v = np.clip(12 + np.cumsum(a) * STEP, 0, 30) + rng.normal(0, 0.01, n)
    v = np.maximum(np.where(np.repeat(rng.random(n // 90 + 1) < 0.15, 90)[:n], 0.0, v), 0.0)
    power = MASS * a * v + rng.normal(0, 500, n)

    def spells(share, length):
        return np.repeat(rng.random(n // length + 1) < share, length)[:n]

    brake, shift, neutral = spells(0.05, 25), spells(0.08, 10), spells(0.1, 60)
    v = np.where(rng.random(n) < 0.003, v + 5.0, np.where(spells(0.04, 17), np.nan, v))
    power = np.where(spells(0.04, 19), np.nan, power)
    return rows_of(
        v,
        power,
        **{
            Role.BRAKE_SWITCH: brake,
            Role.SHIFT_IN_PROCESS: shift & ~neutral,
            Role.DRIVELINE_ENGAGED: ~(neutral | shift),
            Role.GEAR: np.where(neutral, 0, 8),
            Role.ENGINE_SPEED: rng.uniform(80, 180, n),
            Role.ALTITUDE: np.where(spells(0.1, 30), np.nan, np.cumsum(rng.normal(0, 0.1, n))),
            Role.GRADE: rng.normal(0, 0.02, n),
            Role.LONGITUDINAL_ACCELERATION: rng.normal(0, 0.3, n),
            Role.AMBIENT_TEMPERATURE: 290.0,
            Role.AIR_PRESSURE: 1e5,
        },
    )


def assert_same(one: Strides, other: Strides) -> None:
    for each in fields(Strides):
        if each.name != "context":
            np.testing.assert_array_equal(getattr(one, each.name), getattr(other, each.name), err_msg=each.name)
    assert one.context.keys() == other.context.keys()
    for quantity, values in one.context.items():
        np.testing.assert_array_equal(values, other.context[quantity])


# Batches and counts


@pytest.mark.slow
@given(st.integers(0, 10_000), st.lists(st.integers(0, 500), max_size=12))
@settings(deadline=None, max_examples=40)
def test_batches_of_any_size_give_the_same_strides_to_the_bit(seed, cuts):
    rows = messy(seed)
    whole, rejected = strided(rows)
    parts, counted = strided(rows, cuts)
    assert_same(parts, whole)
    assert counted == rejected


@pytest.mark.slow
def test_row_by_row_is_the_same_as_all_at_once():
    rows = messy(7)
    assert_same(strided(rows, range(1, 500))[0], strided(rows)[0])


@given(st.integers(0, 10_000), st.integers(1, 500))
@settings(deadline=None, max_examples=40)
def test_every_row_is_in_a_known_stride_or_counted_for_one_reason(seed, length):
    rows = messy(seed)[:length]
    strides, rejected = strided(rows)
    assert strides.rows[strides.known].sum() + rejected.total() == length
    assert np.all(strides.rows[strides.known] == ROWS)
    assert set(rejected) <= set(Reason)


@given(st.integers(0, 10_000), st.integers(1, 499))
@settings(deadline=None, max_examples=25)
def test_a_restored_strider_goes_on_to_the_bit(seed, cut):
    rows = messy(seed)
    whole, rejected = strided(rows)
    counted: Counter[str] = Counter()
    before = Strider(Admission(), WANTED, 0.0)
    first = before.feed(rows[:cut], counted)
    after = Strider.restore(Admission(), before.state())
    parts = [Strides.restore(first.state()), after.feed(rows[cut:], counted), after.finish(counted)]
    assert_same(Strides.concatenate(parts), whole)
    assert counted == rejected


@pytest.mark.parametrize(
    "change", [{"next": -1}, {"next": 10**6}, {"speed": None}, {"distance": "far"}, {"wanted": ["taste"]}]
)
def test_a_state_that_no_strider_can_have_is_refused(change):
    strider = Strider(Admission(), WANTED, 0.0)
    strider.feed(pull(20), Counter())
    with pytest.raises(StateError):
        Strider.restore(Admission(), strider.state() | change)


@pytest.mark.parametrize("column", ["a", "v0", "force", "s1"])
def test_strides_that_the_model_could_not_use_are_refused(column):
    state = strided(pull(20))[0].state()
    state[column] = np.full_like(state[column], np.nan)
    with pytest.raises(StateError):
        Strides.restore(state)


@pytest.mark.parametrize("n", range(1, 30))
def test_a_few_rows_are_counted_too(n):
    strides, rejected = strided(pull()[:n])
    assert strides.rows[strides.known].sum() + rejected.total() == n


# Values


def test_a_constant_force_gives_acceleration_force_and_distance():
    strides, rejected = strided(pull())
    strides = known(strides)
    assert len(strides) == 59
    assert_allclose(strides.a, 12_000 / MASS, rtol=1e-12)
    assert_allclose(strides.force[:, len(LAGS) // 2], 12_000, rtol=1e-12)
    assert_allclose(strides.speed, 8 + 0.6 * strides.t, rtol=1e-12)
    assert_allclose(strides.power, 12_000 * strides.speed, rtol=1e-12)
    # Distance runs from the middle of the edge at one end to that at the other.
    assert_allclose(strides.s1 - strides.s0, strides.speed * ROWS * STEP, rtol=1e-9)
    assert_allclose(strides.s1[:-1], strides.s0[1:], rtol=1e-12)
    assert rejected == {Reason.INCOMPLETE: 10}


def test_neighbours_share_the_speed_between_them_and_are_joined():
    strides = known(strided(pull())[0])
    assert not strides.joined[0]
    assert strides.joined[1:].all()
    assert_allclose(strides.v1[:-1], strides.v0[1:], rtol=1e-12)


def test_every_quantity_is_averaged_with_the_weights_of_the_acceleration():
    # Any force at all: the speed is its integral by the trapezoid rule.
    force = MASS * np.random.default_rng(5).normal(0, 0.3, 400)
    v = 15 + np.concatenate([[0.0], np.cumsum(0.5 * (force[1:] + force[:-1]))]) * STEP / MASS
    strides = known(strided(rows_of(v, force * v, **{Role.BRAKE_SWITCH: 0.0}))[0])
    assert_allclose(strides.force[:, len(LAGS) // 2], MASS * strides.a, atol=1e-6)


def test_the_lags_take_the_power_later():
    t = STEP * np.arange(600)
    force = 3000 * np.sin(0.4 * t)
    strides, _ = strided(rows_of(np.full(600, 20.0), 20 * force))
    inner = slice(2, -2)
    for lag, column in zip(LAGS, strides.force.T, strict=True):
        here = 3000 * np.sin(0.4 * (strides.t + lag))
        # The mean over a stride damps the sine by the transform of its trapezoid: sinc(0.2) sinc(0.06).
        damped = here * np.sinc(0.4 * 1.0 / 2 / np.pi) * np.sinc(0.4 * 0.3 / 2 / np.pi)
        assert_allclose(column[inner], damped[inner], atol=3.0)


def test_signals_of_the_road_are_read_as_slope_and_gravity():
    n = 300
    v = 10 + 0.03 * np.arange(n)
    signals = {
        Role.ALTITUDE: 100 + 0.05 * np.arange(n),
        Role.GRADE: 0.03,
        Role.LONGITUDINAL_ACCELERATION: 0.3 + 0.25,
        Role.ENGINE_SPEED: 140.0,
    }
    strides = known(strided(rows_of(v, 1e5, **signals))[0])
    assert_allclose(strides.altitude, 100 + 0.5 * strides.t, rtol=1e-9)
    assert_allclose(strides.grade, 0.03 / np.hypot(1, 0.03), rtol=1e-12)
    assert_allclose(strides.gravity, 0.25, rtol=1e-9)
    assert_allclose(strides.gearing, 140 / strides.speed, rtol=1e-3)
    assert_allclose(strides.context[Quantity.ENGINE_SPEED], 140.0)


def test_without_signals_of_road_and_engine_they_are_not_known():
    strides = known(strided(pull())[0])
    for values in (strides.altitude, strides.grade, strides.gravity, strides.density):
        assert np.isnan(values).all()
    assert np.isnan(strides.gearing).all()
    assert_allclose(strides.relative_density, 1.0)
    assert_allclose(strides.filled_gearing(strides.usual_turns), 1 / strides.speed, rtol=1e-3)


def test_an_engine_speed_of_zero_is_not_known_and_the_usual_one_fills_its_gaps():
    n = 300
    turns = np.where(np.arange(n) < 200, 140.0, 0.0)
    strides = known(strided(rows_of(10 + 0.03 * np.arange(n), 1e5, **{Role.ENGINE_SPEED: turns}))[0])
    there = np.isfinite(strides.gearing)
    np.testing.assert_array_equal(there, strides.t < 19.5)
    assert_allclose(strides.filled_gearing(strides.usual_turns), 140 / strides.speed, rtol=1e-3)


# Which forces are known


def with_spell(**context) -> Rows:
    """Sixty seconds at 15 m/s and 50 kW, with a spell of ``context`` from 20 to 30 s."""
    rows = rows_of(np.full(600, 15.0), 5e4)
    during = (rows.t >= 20) & (rows.t < 30)
    for role, (inside, outside) in context.items():
        rows.context[role] = np.where(during, inside, outside).astype(float)
    return rows


OPEN = {Role.SHIFT_IN_PROCESS: (0, 0), Role.DRIVELINE_ENGAGED: (0, 1), Role.GEAR: (0, 10)}


def test_an_open_driveline_has_no_force_whatever_the_engine_does():
    strides, rejected = strided(with_spell(**OPEN))
    inside = (strides.t > 21.5) & (strides.t < 28.5)
    assert strides.known[inside].sum() >= 6
    assert not strides.force[inside & strides.known].any()
    driving = (strides.t < 18) | (strides.t > 32)
    assert_allclose(strides.force[driving & strides.known], 5e4 / 15)
    # Around the moments when it opens and closes, no force is known.
    edges = (np.abs(strides.t - 20) < 0.8) | (np.abs(strides.t - 30) < 0.8)
    assert not strides.known[edges].any()
    assert set(rejected) == {Reason.SHIFTING, Reason.NEAR_EXCLUDED, Reason.INCOMPLETE}


@pytest.mark.parametrize(
    "told",
    [
        {Role.SHIFT_IN_PROCESS: (1, 0), Role.DRIVELINE_ENGAGED: (0, 1), Role.GEAR: (0, 10)},
        {Role.DRIVELINE_ENGAGED: (0, 1), Role.GEAR: (0, 10)},
        {Role.SHIFT_IN_PROCESS: (0, 0), Role.DRIVELINE_ENGAGED: (0, 1)},
        {Role.CLUTCH_SWITCH: (1, 0)},
        {**OPEN, Role.BRAKE_SWITCH: (1, 0)},
    ],
    ids=["gear change", "no word of a change", "no word of the gear", "clutch pedal", "braking in neutral"],
)
def test_a_driveline_that_is_not_surely_open_has_no_known_force(told):
    strides, _ = strided(with_spell(**told))
    inside = (strides.t > 19.5) & (strides.t < 30.5)
    assert inside.any()
    assert not strides.known[inside].any()
    assert strides.known[(strides.t < 18) | (strides.t > 32) & (strides.t < 58)].all()


@pytest.mark.parametrize(
    ("told", "reason"),
    [
        ({Role.BRAKE_SWITCH: (1, 0)}, Reason.BRAKING),
        ({Role.BRAKE_PEDAL: (0.2, 0)}, Reason.BRAKING),
        ({Role.RETARDER_FRACTION: (-0.3, 0)}, Reason.RETARDER),
        ({Role.SHIFT_IN_PROCESS: (1, 0)}, Reason.SHIFTING),
        ({Role.GEAR: (-1, 8)}, Reason.REVERSE),
    ],
)
def test_what_else_moves_the_wheels_is_unknown_but_the_distance_goes_on(told, reason):
    strides, rejected = strided(with_spell(**told))
    inside = (strides.t > 20.6) & (strides.t < 29.4)
    assert not strides.known[inside].any()
    assert rejected[reason] == 100
    after = np.flatnonzero(strides.known & (strides.t > 30))[0]
    assert_allclose(strides.s0[after] - strides.s0[0], 15 * (strides.t[after] - strides.t[0]), rtol=1e-9)
    assert np.all(strides.s0[1:] <= strides.s1[:-1] + 1e-9)  # no part of the road is left out
    assert not strides.joined[after]


def test_crawling_is_not_known():
    strides, rejected = strided(rows_of(np.full(300, 1.8), 5e3))
    assert not strides.known.any()
    assert rejected == {Reason.STANDING: 300}


def test_a_jump_of_the_speed_spoils_only_its_surroundings():
    rows = pull(60)
    rows.speed[300] += 8
    strides, rejected = strided(rows)
    assert rejected[Reason.SPEED_IMPLAUSIBLE] == 3
    assert_allclose(strides.a[strides.known], 0.6, rtol=1e-9)
    assert strides.known.sum() >= 56


def test_standing_still_adds_no_strides():
    moving = np.full(300, 12.0)
    strides, rejected = strided(rows_of(np.concatenate([moving, np.zeros(2000), moving]), 5e4))
    assert len(strides) < 65
    assert rejected[Reason.STANDING] == 2000 - 2  # the first and the last are part of a jump
    assert not np.any((strides.t > 32) & (strides.t < 228))
    assert_allclose(strides.s0[strides.t > 232][0] - strides.s1[strides.t < 28][-1], 0, atol=60)


def test_after_a_silence_the_road_is_another_one():
    rejected: Counter[str] = Counter()
    strider = Strider(Admission(), WANTED, 0.0)
    parts = [strider.feed(pull(30), rejected), strider.finish(rejected)]
    strider.pause()
    later = pull(30)
    later = Rows(
        index=later.index + 1000, speed=later.speed, power=later.power, fresh=later.fresh, context=later.context
    )
    parts += [strider.feed(later, rejected), strider.finish(rejected)]
    strides = Strides.concatenate(parts)
    step = np.diff(strides.s0)
    assert (step > GAP_DISTANCE).sum() == 1
    assert not strides.joined[np.argmax(step) + 1]


def test_a_margin_of_the_configuration_keeps_further_away_from_braking():
    def last_known(margin):
        strider = Strider(msgspec.structs.replace(Config().admission, stride_margin_s=margin), WANTED, 0.0)
        rows = with_spell(**{Role.BRAKE_SWITCH: (1, 0)})
        strides = Strides.concatenate([strider.feed(rows, Counter()), strider.finish(Counter())])
        before = strides[strides.known & (strides.t < 20)]
        return float(before.t[-1])

    assert last_known(0.2) > last_known(3.0) + 1.5


def test_power_not_known_a_moment_before_leaves_the_lagged_force_that_of_the_moment():
    # A driver pulls at 12 kN; the power is not on the bus at first, for longer than any lag reaches.
    for silent in (3, 40):
        rows = pull()
        rows.power[:silent], rows.fresh[:silent, 1] = np.nan, False
        strides, rejected = strided(rows)
        assert rejected[Reason.POWER_STALE] == silent
        first = strides[strides.known][0:1]
        assert_allclose(first.force, 12_000 * np.ones_like(first.force), rtol=0.06)


def test_the_distance_goes_on_at_the_last_speed_while_none_is_known():
    rows = rows_of(np.full(400, 15.0), 5e4)
    rows.speed[100:160], rows.fresh[100:160, 0] = np.nan, False
    strides, rejected = strided(rows, cuts=range(1, 400, 7))
    after = np.flatnonzero(strides.known & (strides.t > 16))[0]
    assert_allclose(strides.s0[after] - strides.s0[0], 15 * (strides.t[after] - strides.t[0]), rtol=1e-9)
    assert rejected[Reason.SPEED_STALE] == 60


# Standstills


@given(
    st.lists(st.tuples(st.booleans(), st.integers(1, 40)), min_size=1, max_size=12),
    st.lists(st.integers(0, 400), max_size=8),
)
def test_a_departure_is_the_first_moving_row_after_a_long_stop_whatever_the_batches(spells, cuts):
    long = 20
    speed = np.concatenate([np.full(length, 5.0 if moves else 0.0) for moves, length in spells])
    standing, expected = 0, []
    for i, v in enumerate(speed):
        if v > 0:
            if standing >= long:
                expected.append(i)
            standing = 0
        else:
            standing += 1
    standstill = Standstill(msgspec.structs.replace(Load(), stop_s=long * STEP), 1.0)
    found = []
    for a, b in pairwise([0, *sorted(min(cut, len(speed)) for cut in cuts), len(speed)]):
        found += [a + i for i in standstill.departures(speed[a:b])]
    assert found == expected


def test_silence_counts_as_standing_and_a_speed_not_known_ends_no_stop():
    standstill = Standstill(msgspec.structs.replace(Load(), stop_s=10.0), 1.0)
    assert standstill.departures(np.full(50, 9.0)) == []
    standstill.pause(60)
    assert standstill.departures(np.full(30, np.nan)) == []
    assert standstill.rows == 90
    restored = Standstill(msgspec.structs.replace(Load(), stop_s=10.0), 1.0)
    restored.restore(standstill.state())
    assert restored.departures(np.array([0.0] * 10 + [5.0])) == [10]
    assert restored.departures(np.array([5.0, 0.0, 5.0])) == []


def test_without_a_brake_signal_a_moment_without_power_may_be_braking():
    power = np.full(200, 50e3)
    power[100:] = 0.0
    shown, counted = strided(rows_of(np.full(200, 15.0), power, **{Role.BRAKE_SWITCH: 0.0}))
    hidden, reasons = strided(rows_of(np.full(200, 15.0), power))
    assert shown.known[:-1].all()
    assert not np.any(hidden.known & (hidden.t > 10.0))
    assert reasons[Reason.MAY_BRAKE] > 80
    assert Reason.MAY_BRAKE not in counted


@pytest.mark.parametrize("part", [7, 61, 1000])
def test_without_a_brake_signal_strides_keep_away_from_moments_without_power_in_any_batches(part):
    power = np.where(np.isin(np.arange(400) // 10, (15, 16)), -1.0, 50e3)  # from 15 to 17 s
    rows = rows_of(np.full(400, 15.0), power)
    whole, counted = strided(rows)
    known = whole.t[whole.known]
    half = 0.5 * (ROWS + EDGE) * STEP  # of a stride, to the end of its last row
    before, after = known[known < 16].max() + half, known[known > 16].min() - half
    assert 15.0 - UNSEEN_MARGIN - 1.0 < before < 15.0 - UNSEEN_MARGIN + STEP
    assert 17.0 + UNSEEN_MARGIN - STEP < after < 17.0 + UNSEEN_MARGIN + STEP
    rejected, strider = Counter[str](), Strider(Admission(), WANTED, 0.0)
    parts = [strider.feed(rows[at : at + part], rejected) for at in range(0, 400, part)]
    again = Strides.concatenate([*parts, strider.finish(rejected)])
    assert_array_equal(again.t, whole.t)
    assert_array_equal(again.known, whole.known)
    assert rejected == counted

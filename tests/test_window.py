"""The window is bounded and keeps what is rare; admission names why a row is left out."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.config import from_dict
from estimator.estimation.window import ACCELERATION_CELLS, MIN_ACCELERATION, SPEED_CELLS, Grid, Window
from estimator.preparation.admission import ADMITTED, Reason, admit, row_reasons
from estimator.samples import STEP, Rows, Samples
from estimator.settings import Admission
from estimator.signals import Role


def block(n: int, start: float = 0.0, v=20.0, a=0.0) -> Samples:
    t = start + STEP * np.arange(n)
    one = np.ones(n)
    v, a = v * one, a * one
    return Samples(t=t, v=v, a=a, P=0 * one, dP=one, zv=v, za=a, zdP=one, density=one)


def window(samples: int = 600, hours: float = 24.0) -> Window:
    return Window(from_dict({"window": {"samples": samples, "hours": hours}}), Samples)


def consistent(w: Window) -> bool:
    held = w.samples
    counts = np.bincount(w.grid.cell(held.v, held.a), minlength=w.grid.size)
    return len(held) == len(w) and np.array_equal(counts, w.counts) and bool(np.all(np.diff(held.t) > 0))


blocks = st.lists(
    st.tuples(st.integers(0, 200), st.floats(0.1, 2000.0), st.floats(1, 35), st.floats(-2, 2)), min_size=1, max_size=40
)


@settings(max_examples=50)
@given(blocks, st.integers(600, 2000), st.floats(0.01, 2.0))
def test_the_window_is_bounded_whatever_comes(sequence, capacity, hours):
    w, t, added = window(capacity, hours), 0.0, 0
    for n, pause, v, a in sequence:
        w.add(block(n, t, v, a))
        t += n * STEP + pause
        added += n
        held = w.samples
        assert len(w) <= capacity
        assert not len(held) or held.t[-1] - held.t[0] <= hours * 3600
        assert consistent(w)
        assert w.added == added == len(w) + w.evicted
    w.clear()
    assert len(w) == len(w.samples) == w.counts.sum() == 0
    assert w.added == added


@settings(max_examples=50)
@given(blocks, st.integers(600, 1200))
def test_the_fullest_block_goes_first(sequence, capacity):
    """Fullness: the mean number of rows in the cells of a block's rows. Numbers of blocks stay."""
    w, t, held, number = window(capacity), 0.0, {}, 0
    for n, pause, v, a in sequence:
        added = block(n, t, v, a)
        w.add(added)
        if n:
            held[number] = added
        t, number = t + n * STEP + pause, number + n
        while sum(map(len, held.values())) > capacity:
            cells = {key: w.grid.cell(one.zv, one.za) for key, one in held.items()}
            counts = np.bincount(np.concatenate([*cells.values()]))
            held.pop(max(held, key=lambda key: counts[cells[key]].mean()))
    assert {key: one.t.tolist() for key, one in w.blocks.items()} == {key: one.t.tolist() for key, one in held.items()}
    again = window(capacity)
    again.restore(w.state())
    assert list(again.blocks) == list(held)
    assert consistent(again)


def test_what_is_older_than_a_time_can_be_forgotten():
    w = window()
    for start in (0.0, 100.0, 200.0):
        w.add(block(50, start))
    w.forget_before(100.0)
    assert w.samples.t[0] == 100.0
    assert consistent(w)
    assert (w.added, w.evicted) == (150, 0)


def test_rare_driving_survives_a_flood_of_cruising():
    w, t = window(6000), 0.0
    rng = np.random.default_rng(1)
    for i in range(300):
        if i % 30 == 5:
            w.add(block(100, t, rng.uniform(3, 15, 100), rng.uniform(0.2, 0.8, 100)))
        else:
            w.add(block(200, t, rng.normal(24, 0.3, 200), rng.normal(0, 0.02, 200)))
        t += 30.0
    held = w.samples
    assert len(w) > 5700
    assert np.count_nonzero(held.a > 0.15) == 10 * 100
    assert consistent(w)


@pytest.mark.slow
def test_what_stays_is_not_chosen_by_its_noise():
    """In a day the rarest twentieth is left; it is rare driving, not readings that noise made look rare."""
    w, rng, n = window(2000), np.random.default_rng(3), 10
    for i in range(4000):
        a, noise, other_noise = rng.normal(0, 0.15), rng.normal(0, 0.1), rng.normal(0, 0.1)
        driven = block(n, 2.0 * i, a=a)
        w.add(replace(driven, a=driven.a + noise, za=driven.a + other_noise, P=driven.a))
    held = w.samples[::n]
    assert np.abs(held.P).mean() > 1.4 * 0.12  # of all driving: 0.15 sqrt(2 / pi)
    moment = (held.a - held.P) * held.za
    assert abs(moment.mean()) < 3 * moment.std() / np.sqrt(len(moment))


def test_a_constant_stream_keeps_the_window_full():
    w = window(1000)
    for i in range(100):
        w.add(block(200, 20.0 * i))
    assert len(w) == 1000
    assert w.evicted == 19_000


@given(st.floats(0, 200), st.floats(-10, 10))
def test_every_point_has_a_cell(v, a):
    grid = Grid(2.5, 0.1)
    cell = grid.cell(np.array([v]), np.array([a]))
    assert 0 <= cell[0] < grid.size


def test_cells_and_centres_agree():
    grid = Grid(2.5, 0.1)
    np.testing.assert_array_equal(grid.cell(*grid.centres()), np.arange(grid.size))
    assert grid.size == SPEED_CELLS * ACCELERATION_CELLS
    assert grid.centres()[1].min() > MIN_ACCELERATION


# Admission


def rows(n: int = 200, **context) -> Rows:
    roles = {Role(name): np.broadcast_to(np.asarray(value, float), n).copy() for name, value in context.items()}
    return Rows(
        index=np.arange(n),
        speed=np.full(n, 20.0),
        power=np.full(n, 1e5),
        fresh=np.ones((n, 2), dtype=bool),
        context=roles,
    )


def reasons(r: Rows, **admission) -> list[str]:
    codes = row_reasons(r, Admission(**admission))
    return ["" if code == ADMITTED else tuple(Reason)[code].value for code in codes]


SITUATIONS = {
    "plain": ({}, ""),
    "gear": ({"gear": 5}, ""),
    "neutral": ({"gear": 0}, Reason.SHIFTING),
    "reverse": ({"gear": -1}, Reason.REVERSE),
    "gear unknown": ({"gear": np.nan}, ""),
    "brake switch": ({"brake_switch": 1}, Reason.BRAKING),
    "brake pedal": ({"brake_pedal": 0.2}, Reason.BRAKING),
    "brake pedal at rest": ({"brake_pedal": 0.004}, ""),
    "park brake": ({"park_brake": 1}, Reason.BRAKING),
    "brakes released": ({"brake_switch": 0, "brake_pedal": 0, "park_brake": 0}, ""),
    "brakes unknown": ({"brake_switch": np.nan, "brake_pedal": np.nan}, ""),
    "retarder": ({"retarder_fraction": -0.3}, Reason.RETARDER),
    "retarder idle": ({"retarder_fraction": 0}, ""),
    "clutch": ({"clutch_switch": 1}, Reason.SHIFTING),
    "shift": ({"shift_in_process": 1}, Reason.SHIFTING),
    "driveline open": ({"driveline_engaged": 0}, Reason.SHIFTING),
    "driveline closed": ({"driveline_engaged": 1, "clutch_switch": 0, "shift_in_process": 0}, ""),
}


@pytest.mark.parametrize("name", SITUATIONS)
def test_context_excludes(name):
    context, reason = SITUATIONS[name]
    assert set(reasons(rows(**context))) == {reason}


def test_speed_and_power_exclude():
    r = rows()
    r.speed[:] = 1.5
    r.fresh[10, 0] = r.fresh[20, 1] = False
    r.speed[[10, 30]] = np.nan
    r.power[[20, 40]] = np.nan
    r.speed[50] = 0.5
    found = reasons(r)
    assert found[10] == Reason.SPEED_STALE
    assert found[20] == Reason.POWER_STALE
    assert found[30] == Reason.SPEED_NOT_AVAILABLE
    assert found[40] == Reason.POWER_NOT_AVAILABLE
    assert found[50] == Reason.STANDING
    assert Counter(found)[""] == 195


def test_jumps_of_the_speed_exclude_both_sides():
    r = rows()
    r.speed[100:] = 12.0
    r.speed[150] = 13.1
    found = reasons(r)
    assert [i for i, reason in enumerate(found) if reason] == [99, 100]
    assert found[99] == found[100] == Reason.SPEED_IMPLAUSIBLE


def test_standing_is_a_setting():
    r = rows()
    r.speed[:] = 2.0
    assert set(reasons(r)) == {""}
    assert set(reasons(r, minimum_speed_m_s=3.0)) == {Reason.STANDING}


@pytest.mark.parametrize(("role", "value"), [("brake_switch", 1), ("shift_in_process", 1), ("retarder_fraction", -0.5)])
@pytest.mark.parametrize("margin", [0.0, 0.5, 1.5])
def test_a_margin_is_kept_on_either_side(role, value, margin):
    r = rows(**{role: 0})
    r.context[Role(role)][100:110] = value
    found = np.array(reasons(r, margin_s=margin))
    reach = round(margin / STEP)
    near = np.flatnonzero(found == Reason.NEAR_EXCLUDED)
    np.testing.assert_array_equal(near, [*range(100 - reach, 100), *range(110, 110 + reach)])
    assert (found != "").sum() == 10 + 2 * reach


def test_standing_comes_before_braking():
    r = rows(brake_switch=1)
    r.speed[:] = 0.0
    assert set(reasons(r)) == {Reason.STANDING}


def test_admit_counts_each_row_once():
    r = rows(brake_switch=0)
    r.context[Role.BRAKE_SWITCH][50:60] = 1
    samples = block(200)
    samples.dP[150:160] = np.nan
    samples.zv[55:58] = np.nan
    rejected: Counter[str] = Counter()
    admitted = admit(samples, row_reasons(r, Admission(margin_s=0.5)), rejected)
    assert rejected == {Reason.BRAKING: 10, Reason.NEAR_EXCLUDED: 10, Reason.INCOMPLETE: 10}
    assert len(admitted) + rejected.total() == 200
    assert np.isfinite(admitted.dP).all()

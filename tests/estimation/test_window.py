"""The window is bounded and keeps what is rare; admission names why a row is left out."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_strides import made_strides

from estimator.config import from_dict
from estimator.estimation.window import CELLS, MIN_ACCELERATION, Grid, Window
from estimator.preparation.admission import ADMITTED, Reason, count_reasons, row_reasons
from estimator.samples import STEP, Rows
from estimator.settings import Admission
from estimator.signals import Role
from estimator.strides import Strides


def block(n: int, start: float = 0.0, v=20.0, a=0.0) -> Strides:
    """Short strides, of one row each."""
    one = np.ones(n)
    made = made_strides(np.zeros(n + 1), np.zeros(n), {})
    t = start + STEP * np.arange(n)
    return replace(made, t=t, rows=one.astype(np.int64), v0=v * one, v1=v * one, a=a * one)


def window(samples: int = 600, hours: float = 24.0) -> Window:
    return Window(from_dict({"window": {"samples": samples, "hours": hours}}))


def consistent(w: Window) -> bool:
    held = w.strides
    counts = np.bincount(w.grid.cell(held.speed, held.a), minlength=w.grid.size)
    return len(held) == len(w) and np.array_equal(counts, w.counts) and bool(np.all(np.diff(held.t) > 0))


def consistent_known(w: Window) -> bool:
    held = w.strides[w.strides.known]
    counts = np.bincount(w.grid.cell(held.speed, held.a), minlength=w.grid.size)
    return len(held) == len(w) and np.array_equal(counts, w.counts)


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
        held = w.strides
        assert len(w) <= capacity
        assert not len(held) or held.t[-1] - held.t[0] <= hours * 3600
        assert consistent(w)
        assert w.added == added == len(w) + w.evicted
    w.clear()
    assert len(w) == len(w.strides) == w.counts.sum() == 0
    assert w.added == added


@pytest.mark.slow
@settings(max_examples=50)
@given(blocks, st.integers(600, 1200))
def test_the_fullest_block_goes_first(sequence, capacity):
    """Fullness: the mean number of rows in the cells of a block's rows."""
    w, t, held, number = window(capacity), 0.0, {}, 0
    for n, pause, v, a in sequence:
        added = block(n, t, v, a)
        w.add(added)
        if n:
            held[number] = added
        t, number = t + n * STEP + pause, number + n
        allowed = capacity if sum(map(len, held.values())) <= capacity else 0.9 * capacity
        while sum(map(len, held.values())) > allowed:
            cells = {key: w.grid.cell(one.speed, one.a) for key, one in held.items()}
            counts = np.bincount(np.concatenate([*cells.values()]))
            held.pop(max(held, key=lambda key: counts[cells[key]].mean()))
    assert w.strides.t.tolist() == [t for one in held.values() for t in one.t.tolist()]
    again = window(capacity)
    again.restore(w.state())
    assert again.strides.t.tolist() == w.strides.t.tolist()
    assert consistent(again)


def test_what_is_older_than_a_time_can_be_forgotten():
    w = window()
    for start in (0.0, 100.0, 200.0):
        w.add(block(50, start))
    w.forget_before(100.0)
    assert w.strides.t[0] == 100.0
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
    held = w.strides
    assert len(w) > 5400 - 200  # a tenth less, and a block
    assert np.count_nonzero(held.a > 0.15) == 10 * 100
    assert consistent(w)


def test_strides_without_a_known_force_are_forgotten_with_the_driving_that_they_join():
    w, t = window(1000), 0.0
    for i in range(60):
        made = block(50, t, 20.0 if i % 2 else 25.0)
        w.add(replace(made, known=np.zeros(50, bool)) if i % 4 in (1, 2) else made)
        t += 5.0
        assert consistent_known(w)
    held, edges = w.strides, np.diff(w.strides.known.astype(int))
    begins, ends = np.flatnonzero(edges < 0), np.flatnonzero(edges > 0)
    assert w.evicted > 0
    assert 0 < np.count_nonzero(~held.known) < 0.8 * 30 * 50  # of those that came
    for place in (*begins, *ends[ends > begins[0]]):
        assert held.t[place + 1] - held.t[place] == pytest.approx(STEP)  # what they join is there, on either side


def test_a_constant_stream_keeps_the_window_nearly_full():
    """What is over a limit makes room for a tenth of it, so that the strides stay the same for a while."""
    w, held = window(4000), []
    for i in range(100):
        w.add(block(200, 20.0 * i))
        held.append(len(w))
    assert max(held) == 4000
    assert set(held[20:]) == {3600, 3800, 4000}
    assert w.evicted == 20_000 - len(w)


def test_driving_beyond_the_limit_of_age_makes_room_for_a_tenth_of_it():
    w, oldest = window(10_000, hours=0.5), []
    for i in range(200):
        w.add(block(20, 20.0 * i))
        oldest.append(w.strides.t[-1] - w.strides.t[0])
    assert 0.95 * 1800 < max(oldest) <= 1800 + 20
    assert min(oldest[100:]) == pytest.approx(0.9 * 1800, abs=40)


@given(st.floats(0, 200), st.floats(-10, 10))
def test_every_point_has_a_cell(v, a):
    grid = Grid(2.5, 0.1)
    cell = grid.cell(np.array([v]), np.array([a]))
    assert 0 <= cell[0] < grid.size


def test_cells_and_centres_agree():
    grid = Grid(2.5, 0.1)
    np.testing.assert_array_equal(grid.cell(*grid.centres()), np.arange(grid.size))
    assert grid.size == CELLS * CELLS
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
    found = np.array(reasons(r, stride_margin_s=margin))
    reach = round(margin / STEP)
    near = np.flatnonzero(found == Reason.NEAR_EXCLUDED)
    np.testing.assert_array_equal(near, [*range(100 - reach, 100), *range(110, 110 + reach)])
    assert (found != "").sum() == 10 + 2 * reach


def test_standing_comes_before_braking():
    r = rows(brake_switch=1)
    r.speed[:] = 0.0
    assert set(reasons(r)) == {Reason.STANDING}


def test_each_row_is_counted_once():
    r = rows(brake_switch=0)
    r.context[Role.BRAKE_SWITCH][50:60] = 1
    rejected: Counter[str] = Counter()
    codes = row_reasons(r, Admission(stride_margin_s=0.5))
    count_reasons(codes[40:80], rejected)
    assert rejected == {Reason.BRAKING: 10, Reason.NEAR_EXCLUDED: 10, Reason.INCOMPLETE: 20}

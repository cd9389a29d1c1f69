"""The low-passed speed: against the analytic answer, over gaps, and however the rows are cut."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator.errors import StateError
from estimator.preparation.past_speed import PastSpeed
from estimator.preparation.recursion import low_passed
from estimator.roles import PAST_SPEEDS
from estimator.samples import STEP

TIMES = np.array([*PAST_SPEEDS.values()])


def followed(past: PastSpeed, first: int, speed) -> np.ndarray:
    """Low-passed speeds (k, n)."""
    found = past.follow(first + np.arange(len(speed)), np.asarray(speed, dtype=float))
    assert list(found) == list(PAST_SPEEDS)
    return np.array([*found.values()])


def test_a_step_of_speed_is_approached_exponentially():
    n = 30_000
    found = followed(PastSpeed(), 7, np.full(n, 20.0))
    t = STEP * np.arange(1, n + 1)
    np.testing.assert_allclose(found, 20.0 * (1 - np.exp(-t / TIMES[:, None])), rtol=1e-9)


def test_the_vehicle_stands_while_the_bus_is_silent():
    past = PastSpeed()
    before = followed(past, 0, np.full(9000, 15.0))[:, -1]
    after = followed(past, 9000 + 6000, [0.0])[:, 0]
    np.testing.assert_allclose(after, before * np.exp(-(6001 * STEP) / TIMES), rtol=1e-9)


def test_an_unknown_speed_is_that_before():
    speed = np.full(100, 12.0)
    gaps = speed.copy()
    gaps[30:40] = np.nan
    np.testing.assert_array_equal(followed(PastSpeed(), 0, gaps), followed(PastSpeed(), 0, speed))
    assert not followed(PastSpeed(), 0, np.full(5, np.nan)).any()


def test_tyres_are_cold_where_time_is_set_back_or_the_vehicle_may_be_another_one():
    fresh = followed(PastSpeed(), 50, np.full(20, 9.0))
    for forgotten in (False, True):
        past = PastSpeed()
        followed(past, 100 if not forgotten else 0, np.full(30, 20.0))
        if forgotten:
            past.forget()
        np.testing.assert_array_equal(followed(past, 50, np.full(20, 9.0)), fresh)


@given(
    st.lists(st.sampled_from([0.0, 3.7, 22.2, np.nan]), min_size=1, max_size=60),
    st.lists(st.integers(1, 20), min_size=1, max_size=10),
)
def test_any_cut_and_any_restart_give_the_same_bits(speed, cuts):
    whole = followed(PastSpeed(), 1000, speed)
    past, parts, at = PastSpeed(), [], 0
    for cut in (*cuts, len(speed)):
        if at < len(speed):
            parts.append(followed(past, 1000 + at, speed[at : at + cut]))
            at += cut
            again = PastSpeed()
            again.restore(past.state())
            past = again
    np.testing.assert_array_equal(np.concatenate(parts, axis=1), whole[:, : min(at, len(speed))])


def test_a_state_that_is_none_is_refused():
    state = PastSpeed().state()
    for wrong in ({"values": np.zeros(2)}, {"values": np.full(len(TIMES), np.nan)}, {"speed": "fast"}, {"next": 1.5}):
        with pytest.raises(StateError):
            PastSpeed().restore({**state, **wrong})


def test_a_low_pass_in_coarse_steps_is_that_in_fine_ones():
    fine = low_passed(np.repeat(np.linspace(0, 20, 300), 10), 4.0, 0.1, 600.0)
    coarse = low_passed(np.linspace(0, 20, 300), 4.0, 1.0, 600.0)
    np.testing.assert_allclose(coarse, fine[9::10], rtol=1e-9)

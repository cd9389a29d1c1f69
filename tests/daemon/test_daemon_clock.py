"""Message times stay monotone and true while the wall clock is set."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator.daemon.reception.message_clock import MIN_LATENESS, MessageClock

EPOCH = 1_700_000_000.0


def drained(clock: MessageClock, truth: np.ndarray, ahead: np.ndarray | float, delay: float = 0.02) -> np.ndarray:
    """What the clock makes of frames at monotonic times ``truth`` (n,), drained every 50 ms."""
    turn = np.floor((truth + 1e-9) / 0.05)
    edges = np.flatnonzero(np.diff(turn)) + 1
    batches = zip(np.split(truth, edges), np.split(truth + ahead, edges), strict=True)
    return np.concatenate([clock.correct(stamps, batch[-1] + delay) for batch, stamps in batches])


@pytest.mark.parametrize("step", [3600.0, -3600.0, 5.0, -5.0, 1.8e9, -1.6e9])
def test_a_step_of_the_wall_clock_is_taken_out(step: float) -> None:
    clock = MessageClock(EPOCH)
    truth = np.arange(0.0, 20.0, 0.01)
    t = drained(clock, truth, EPOCH + np.where(truth < 10.003, 0.0, step))
    assert clock.steps == 1
    np.testing.assert_allclose(t - t[0], truth - truth[0], atol=0.05)


@pytest.mark.parametrize("asleep", [10.0, 600.0, 8 * 3600.0, 3 * 86400.0])
def test_frames_from_before_a_suspension_that_are_drained_after_it_are_no_step(asleep: float) -> None:
    """Wall and monotonic time both jump by the time asleep; what lay in the buffer meanwhile has the time of before."""
    clock = MessageClock(EPOCH)
    before = np.arange(0.0, 20.0, 0.01)
    drained(clock, before, EPOCH)
    buffered = 20.0 + np.arange(0.0, 0.5, 0.01)
    t = clock.correct(EPOCH + buffered, 20.0 + asleep)
    np.testing.assert_allclose(t, EPOCH + buffered, atol=0.05)
    after = 20.0 + asleep + np.arange(0.0, 20.0, 0.01)
    np.testing.assert_allclose(drained(clock, after, EPOCH), EPOCH + after, atol=0.1)
    assert clock.steps == 0
    assert clock.at(after[-1]) == pytest.approx(EPOCH + after[-1], abs=0.1)


def test_time_runs_on_through_many_steps() -> None:
    clock = MessageClock(EPOCH)
    truth = np.arange(0.0, 60.0, 0.02)
    ahead = EPOCH + 3600 * (np.floor(truth / 10) % 2)
    t = drained(clock, truth, ahead)
    assert clock.steps == 5
    np.testing.assert_allclose(t - t[0], truth - truth[0], atol=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.15, 0.3, 0.9])
@pytest.mark.parametrize("sign", [1, -1])
def test_small_steps_every_minute_are_taken_out_too(size: float, sign: int) -> None:
    clock = MessageClock(EPOCH)
    truth = np.arange(0.0, 600.0, 0.02)
    ahead = EPOCH + sign * size * np.floor((truth + 30.007) / 60)
    t = drained(clock, truth, ahead)
    assert clock.steps == 10
    np.testing.assert_allclose(t - t[0], truth - truth[0], atol=0.08)


def test_batches_that_come_late_at_random_are_no_step() -> None:
    clock, rng = MessageClock(EPOCH), np.random.default_rng(1)
    out, now = [], 0.0
    truth = np.arange(0.0, 300.0, 0.02)
    while len(truth):
        now += rng.uniform(0.01, 0.1) + (rng.random() < 0.05) * rng.uniform(0, 0.8)
        waiting = truth < now - rng.uniform(0.0, 0.03)
        if waiting.any():
            out.append(clock.correct(EPOCH + truth[waiting], now))
            truth = truth[~waiting]
    assert clock.steps == 0
    t = np.concatenate(out)
    np.testing.assert_allclose(t, EPOCH + np.arange(len(t)) * 0.02, atol=1e-6)


def test_lateness_that_ends_is_no_step() -> None:
    clock = MessageClock(EPOCH)
    truth = np.arange(0.0, 100.0, 0.02)
    late = np.concatenate([drained(clock, truth[:2500], EPOCH, 0.4), drained(clock, truth[2500:], EPOCH, 0.02)])
    assert clock.steps == 0
    np.testing.assert_allclose(late, EPOCH + truth, atol=1e-6)


def test_drift_is_no_step() -> None:
    clock = MessageClock(EPOCH)
    truth = np.arange(0.0, 3000.0, 0.5)
    t = drained(clock, truth, EPOCH + truth * 500e-6)
    assert clock.steps == 0
    assert t[-1] - t[0] == pytest.approx(truth[-1] * (1 + 500e-6), abs=0.1)


def test_frames_that_were_kept_waiting_are_no_step() -> None:
    clock = MessageClock(EPOCH)
    clock.correct(EPOCH + np.arange(0.0, 1.0, 0.1), 1.0)
    held = clock.correct(EPOCH + np.arange(1.0, 2.0, 0.1), 9.0)  # the process slept, and the buffer overflowed
    after = clock.correct(EPOCH + np.arange(9.0, 9.1, 0.1), 9.1)
    assert clock.steps == 0
    np.testing.assert_allclose(held, EPOCH + np.arange(1.0, 2.0, 0.1))
    assert after[0] == pytest.approx(EPOCH + 9.0)


def test_a_step_back_hidden_in_a_silence_is_found() -> None:
    clock = MessageClock(EPOCH)
    clock.correct(np.array([EPOCH]), 0.0)
    truth = np.arange(100.0, 120.0, 0.1)
    t = drained(clock, truth, EPOCH - 50.0)
    assert clock.steps == 1
    assert t[-1] == pytest.approx(EPOCH + truth[-1], abs=0.2)


def test_messages_without_a_time_get_that_of_their_arrival() -> None:
    clock = MessageClock(EPOCH)
    np.testing.assert_allclose(clock.correct(np.zeros(3), 5.0), EPOCH + 5.0)
    np.testing.assert_allclose(clock.correct(np.array([np.nan]), 6.0), EPOCH + 6.0)


@pytest.mark.slow
@given(
    st.lists(
        st.tuples(
            st.floats(0, 1000),
            st.lists(st.floats(allow_nan=True, allow_infinity=True, width=64), max_size=5),
        ),
        max_size=20,
    )
)
def test_no_stamps_break_the_order_or_run_ahead(batches: list[tuple[float, list[float]]]) -> None:
    clock, now, last = MessageClock(EPOCH), 0.0, -np.inf
    for wait, stamps in batches:
        now += wait
        t = clock.correct(np.array(stamps), now)
        if len(t):
            assert np.isfinite(t).all()
            assert (np.diff(t) >= 0).all()
            assert t[0] >= last
            assert t[-1] <= max(clock.at(now) + MIN_LATENESS, last)
            last = t[-1]

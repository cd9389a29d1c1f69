"""Frames that come a little late are put in order; what steps back further is another recording."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator.can_io.frames import Frames
from estimator.can_io.time_order import MAX_DELAY, NO_TIME, TimeOrder

FIELDS = ("t", "ident", "length", "data")
MICROSECONDS = 1e6  # 1/s


def frames(t: list[float]) -> Frames:
    """Frames at times ``t`` [s], told apart by their payload."""
    n = len(t)
    data = np.zeros((n, 8), np.uint8)
    data[:, 0], data[:, 1] = np.arange(n) % 256, np.arange(n) // 256
    return Frames(np.array(t, float), np.full(n, 0x123, np.uint32), np.full(n, 8, np.uint8), data)


def fed(order: TimeOrder, arriving: Frames, cuts: list[int]) -> list[Frames]:
    parts = [arriving[a:b] for a, b in pairwise([0, *sorted(cuts), len(arriving)])]
    return [out for part in parts for out in order.feed(part)] + [order.finish()]


def assert_same(got: Frames, want: Frames) -> None:
    for field in FIELDS:
        assert np.array_equal(getattr(got, field), getattr(want, field)), field


@st.composite
def shuffled(draw: st.DrawFn) -> tuple[Frames, Frames, list[int]]:
    """A log in order, the same with every frame up to 1 s late, and where it is cut into batches."""
    steps = draw(st.lists(st.integers(1, 400_000), min_size=1, max_size=60))
    delays = draw(st.lists(st.integers(0, 999_990), min_size=len(steps), max_size=len(steps)))
    at = 1_700_000_000_000_000 + np.cumsum(steps)
    log = frames((at / MICROSECONDS).tolist())
    cuts = draw(st.lists(st.integers(0, len(steps)), max_size=5))
    return log, log[np.argsort(at + delays, kind="stable")], cuts


@given(shuffled())
def test_any_shuffle_within_a_second_gives_the_sorted_log(case: tuple[Frames, Frames, list[int]]) -> None:
    log, arriving, cuts = case
    order = TimeOrder()
    assert_same(Frames.concatenate(fed(order, arriving, cuts)), log)
    latest = np.maximum.accumulate(arriving.t)
    assert order.reordered == np.count_nonzero(arriving.t < latest)
    assert order.steps_back == 0


@given(shuffled())
def test_frames_of_equal_time_stay_in_order_of_arrival(case: tuple[Frames, Frames, list[int]]) -> None:
    log, _, cuts = case
    coarse = replace(log, t=np.floor(log.t))
    order = TimeOrder()
    assert_same(Frames.concatenate(fed(order, coarse, cuts)), coarse)
    assert order.reordered == 0


@pytest.mark.parametrize("cuts", [[], [3], [4], [1, 2, 3, 4, 5, 6]])
def test_a_larger_step_back_is_another_recording(cuts: list[int]) -> None:
    order = TimeOrder()
    arriving = frames([10.0, 10.2, 10.1, 11.0, 3.0, 3.2, 3.1])
    parts = [part for part in fed(order, arriving, cuts) if len(part)]
    assert np.concatenate([part.t for part in parts]).tolist() == [10.0, 10.1, 10.2, 11.0, 3.0, 3.1, 3.2]
    assert all(np.all(np.diff(part.t) >= 0) for part in parts)
    assert (order.reordered, order.steps_back) == (2, 1)


def test_creeping_back_ends_in_a_step() -> None:
    order = TimeOrder()
    fed(order, frames([10.0, 9.4, 8.8, 8.2]), [])
    assert (order.reordered, order.steps_back) == (2, 1)


def test_a_frame_waits_for_a_second_of_traffic_and_no_longer() -> None:
    order = TimeOrder()
    out = [[frame for part in order.feed(frames([t])) for frame in part.t.tolist()] for t in (0.0, 0.9, 1.5, 2.5)]
    assert out == [[], [], [0.0], [0.9, 1.5]]
    assert order.finish().t.tolist() == [2.5]


@pytest.mark.parametrize("bad", [-1.0, float("nan"), float("inf"), -float("inf"), 1e17, 1e300])
def test_frames_without_a_usable_time_are_counted_and_left_out(bad: float) -> None:
    order = TimeOrder()
    arriving = frames([1.0, bad, 1.1, bad, 3.0])
    assert Frames.concatenate(fed(order, arriving, [2])).t.tolist() == [1.0, 1.1, 3.0]
    assert order.refused == {NO_TIME: 2}
    assert order.steps_back == 0


def test_memory_is_bounded_where_time_stands_still(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("estimator.can_io.time_order.MAX_HELD", 100)
    order = TimeOrder()
    given_back = [len(part) for _ in range(10) for part in order.feed(frames([5.0] * 60))]
    assert sum(given_back) == 500
    assert len(order.finish()) == 100


def test_the_delay_is_a_second() -> None:
    assert MAX_DELAY == 1.0

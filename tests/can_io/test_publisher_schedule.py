"""When the publisher speaks: rates, gaps, clocks that step back, age and change of status."""

from collections import defaultdict
from itertools import pairwise

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st
from made_estimates import made_estimate

from estimator.can_io.publisher import Publisher, output_database
from estimator.estimates import Status
from estimator.settings import Publish

STATUS, MASS, ROAD = 0x18FF60FB, 0x18FF61FB, 0x18FF65FB

starts = st.sampled_from([0.0, 12.3, 1.7e9])
steps = st.lists(st.floats(0.0, 0.9), min_size=1, max_size=200)


def read(frames: list[can.Message], name: str) -> str | float:
    """Value of one signal in the last frame that has it."""
    for frame in reversed(frames):
        values = output_database().decode_message(frame.arbitration_id, bytes(frame.data))
        if name in values:
            return values[name] if isinstance(values[name], (int, float)) else str(values[name])
    raise AssertionError(f"{name} was not sent")


def times(start: float, distances: list[float]) -> list[float]:
    result = [start]
    for distance in distances:
        result.append(result[-1] + distance)
    return result


@pytest.mark.slow
@given(starts, steps)
def test_rates_over_random_polls(start: float, distances: list[float]) -> None:
    publisher = Publisher(Publish())
    stamps = defaultdict(list)
    polls = times(start, distances)
    for t in polls:
        for frame in publisher.poll(t, None):
            assert t - 1.0 < frame.timestamp <= t or frame.arbitration_id != STATUS
            stamps[frame.arbitration_id].append(frame.timestamp)
    elapsed = polls[-1] - start
    assert stamps[STATUS] == stamps[ROAD] == pytest.approx([start + k for k in range(int(elapsed) + 1)], abs=1e-6)
    for group in range(MASS, MASS + 4 * 256, 256):
        assert stamps[group] == pytest.approx([start + 10 * k for k in range(int(elapsed / 10) + 1)], abs=1e-6)


@pytest.mark.slow
@given(starts, st.lists(st.floats(0.0, 5000.0), max_size=50))
def test_no_burst_after_a_gap_and_stamps_in_order(start: float, distances: list[float]) -> None:
    publisher = Publisher(Publish())
    last = start
    for t in times(start, distances):
        frames = publisher.poll(t, None)
        assert len({frame.arbitration_id for frame in frames}) == len(frames)
        for frame in frames:
            assert last <= frame.timestamp <= t
            last = frame.timestamp


@pytest.mark.slow
@given(st.lists(st.tuples(st.floats(-1e6, 1e6), st.none() | st.sampled_from(Status))))
def test_same_polls_same_bytes(polls: list[tuple[float, Status | None]]) -> None:
    def run() -> list[tuple[float, int, bytes]]:
        publisher = Publisher(Publish(cvw=True))
        frames = [f for t, status in polls for f in publisher.poll(t, status and made_estimate(t - 5, status))]
        return [(f.timestamp, f.arbitration_id, bytes(f.data)) for f in frames]

    assert run() == run()


def test_after_a_gap_the_grid_goes_on() -> None:
    publisher = Publisher(Publish())
    publisher.poll(0.0, None)
    assert [f.timestamp for f in publisher.poll(34.5, None)] == [30.0] * 4 + [34.0] * 2
    assert publisher.poll(34.9, None) == []
    assert [f.timestamp for f in publisher.poll(35.0, None)] == [35.0] * 2


def test_counter_rolls_past_14_and_counts_each_message_alone() -> None:
    publisher = Publisher(Publish())
    frames = [f for t in range(40) for f in publisher.poll(float(t), None)]
    for ident, n in ((STATUS, 40), (MASS, 4)):
        seen = [f.data[6] & 0xF for f in frames if f.arbitration_id == ident]
        assert seen == [k % 15 for k in range(n)]


def test_change_of_status_is_sent_at_once() -> None:
    publisher = Publisher(Publish())
    publisher.poll(0.0, None)
    frames = publisher.poll(0.25, made_estimate(0.25))
    assert len(frames) == 6
    assert all(f.timestamp == 0.25 for f in frames)
    assert read(frames, "MassMean") == 27190
    assert publisher.poll(1.0, made_estimate(0.25)) == []
    frames = publisher.poll(1.1, made_estimate(1.1, Status.INVALID))
    assert len(frames) == 6
    assert read(frames, "MassMean") == read(frames, "ADeviation") == "error"
    assert read(frames, "EstimateStatus") == "invalid"
    assert read(publisher.poll(1.2, made_estimate(1.2)), "MassMean") == 27190


def test_values_are_withdrawn_when_stale_and_return_with_a_new_estimate() -> None:
    publisher = Publisher(Publish(stale_after_s=60.0))
    assert read(publisher.poll(0.0, made_estimate(0.0)), "EstimateStatus") == "estimated"
    publisher.poll(59.5, made_estimate(0.0))
    assert publisher.poll(59.9, made_estimate(0.0)) == []
    frames = publisher.poll(60.5, made_estimate(0.0))
    assert len(frames) == 6
    assert read(frames, "EstimateStatus") == "stale"
    assert {read(frames, name) for name in ("MassQ05", "CMean", "Coverage", "SampleCount")} == {"not available"}
    assert read(frames, "EstimateAge") == 60
    assert read(publisher.poll(61.0, made_estimate(60.9)), "MassMean") == 27190


def test_clock_set_back_starts_anew_and_does_not_make_an_estimate_young() -> None:
    publisher = Publisher(Publish(stale_after_s=60.0))
    old = made_estimate(10_000.0)
    publisher.poll(10_030.0, old)
    frames = publisher.poll(5_000.0, old)
    assert [f.timestamp for f in frames] == [5_000.0] * 6
    assert read(frames, "EstimateAge") == 30
    assert [f.timestamp for f in publisher.poll(5_001.5, old)] == [5_001.0] * 2
    assert read(publisher.poll(5_031.0, old), "EstimateStatus") == "stale"
    assert read(publisher.poll(5_032.0, made_estimate(5_032.0)), "EstimateAge") == 0


def test_estimate_from_a_time_to_come_is_not_trusted() -> None:
    frames = Publisher(Publish()).poll(10.0, made_estimate(1e6))
    assert read(frames, "EstimateStatus") == "stale"
    assert read(frames, "EstimateAge") == read(frames, "MassMean") == "not available"


@pytest.mark.slow
@given(st.lists(st.floats(0.0, 0.5), min_size=2, max_size=100))
def test_jitter_of_time_stamps_sends_nothing_twice(jitter: list[float]) -> None:
    publisher = Publisher(Publish())
    stamps = []
    for k, back in enumerate(jitter):
        stamps += [f.timestamp for f in publisher.poll(0.1 * k - back, None) if f.arbitration_id == STATUS]
    assert all(later - earlier > 0.999 for earlier, later in pairwise(stamps))


def test_jitter_at_the_stale_limit_does_not_toggle_the_status() -> None:
    publisher = Publisher(Publish(stale_after_s=60.0))
    sent = [publisher.poll(t, made_estimate(0.0)) for t in (0.0, 60.1, 59.9, 60.2, 59.8, 60.3)]
    assert [len(frames) for frames in sent] == [6, 6, 0, 0, 0, 0]

"""Silence and thin traffic: no rows, no work, and a sentence that says why."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.can_io.frames import EXTENDED, Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.config import from_dict
from estimator.errors import MissingInputsError
from estimator.samples import Rows
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.alignment import MAX_SILENCE
from estimator.streaming.row_counts import SILENT
from estimator.streaming.row_stream import Block, Interruption, RowStream

START = 1.7e9  # s
CCVS, EEC1 = 0x18FEF100 | EXTENDED, 0x0CF00400 | EXTENDED


@pytest.fixture(scope="module")
def drive() -> Frames:
    rng = np.random.default_rng(1)
    truck = Truck(mass=27_190.0, A=1739.0, C=3.74)
    return frames_of(record(truck, generate_route("mixed", 3e3, rng), 150.0, rng).signals)


def pairs(drive: Frames, step: float, count: int) -> Frames:
    """One frame with speed and one with torque every ``step`` [s]."""
    both = [drive[drive.ident == ident][np.arange(count) % 400] for ident in (CCVS, EEC1)]
    t = START + step * np.arange(count)
    joined = Frames.concatenate([replace(frames, t=t + 0.01 * i) for i, frames in enumerate(both)])
    return joined[np.argsort(joined.t, kind="stable")]


def moved(frames: Frames, to: float) -> Frames:
    return replace(frames, t=frames.t - frames.t[0] + to)


def rows_of(stream: RowStream, batches: list[Frames]) -> list[Rows | float]:
    """Rows joined where nothing is between them, and the ends of interruptions."""
    parts: list[Rows | float] = []
    for item in stream.feed_all(batches):
        if isinstance(item, Interruption):
            parts.append(item.end)
            continue
        for rows in item.rows:
            last = parts[-1] if parts else None
            if isinstance(last, Rows) and rows.index[0] == last.index[-1] + 1:
                parts[-1] = Rows.concatenate(last, rows)
            else:
                parts.append(rows)
    return parts


@pytest.mark.slow
def test_a_pair_of_frames_every_ten_seconds_for_a_day_makes_few_rows(drive: Frames) -> None:
    stream = RowStream(from_dict({}))
    items = list(stream.feed_all([pairs(drive, 10.0, 8640)]))
    assert len(items) < 100  # of 17,280 blocks of 5 s
    blocks = [item for item in items if isinstance(item, Block)]
    assert sum(len(rows) for block in blocks for rows in block.rows) <= (MAX_SILENCE + 10.0) * 10
    assert stream.rows.unusable[SILENT] > 863_000
    assert sum(len(block.frames) for block in blocks) == 2 * 8640


@pytest.mark.parametrize("step", [10.0, 20.0, 0.02 * 60_000])
def test_inputs_that_come_too_seldom_are_told_with_the_unit_that_would_fit(drive: Frames, step: float) -> None:
    stream = RowStream(from_dict({}))
    list(stream.feed_all([pairs(drive, step, 50)]))
    with pytest.raises(MissingInputsError) as caught:
        stream.require_inputs("a.log")
    unit = "milliseconds, divide them by 1,000" if step <= 1000 else "microseconds, divide them by 1,000,000"
    assert f"comes every {step:.3g} s, too seldom to see how it changes" in str(caught.value)
    assert f"if the times of the log are {unit}" in str(caught.value)


def test_inputs_that_come_every_second_are_used(drive: Frames) -> None:
    stream = RowStream(from_dict({}))
    list(stream.feed_all([pairs(drive, 1.0, 300)]))
    assert not stream.rows.unusable[SILENT]
    with pytest.raises(MissingInputsError, match="missing inputs"):
        stream.require_inputs("a.log")


@pytest.mark.slow
@pytest.mark.parametrize("batch", [31, 997])
def test_rows_around_thin_traffic_do_not_depend_on_the_batches(drive: Frames, batch: int) -> None:
    drive = drive[drive.t < drive.t[0] + 60.0]
    parked = pairs(drive, 10.0, 15)
    traffic = Frames.concatenate(
        [moved(drive, START), moved(parked, START + 70.0), moved(drive, START + 230.0), moved(parked, START + 300.0)]
    )
    want = rows_of(RowStream(from_dict({})), [traffic])
    stream = RowStream(from_dict({}))
    found = rows_of(stream, [traffic[i : i + batch] for i in range(0, len(traffic), batch)])
    assert [type(part) for part in found] == [type(part) for part in want] == [Rows, float, Rows]
    assert found[1] == want[1]
    for rows, others in ((found[0], want[0]), (found[2], want[2])):
        assert isinstance(rows, Rows)
        assert isinstance(others, Rows)
        assert rows.index.tolist() == others.index.tolist()
        for name in ("speed", "power", "fresh"):
            assert getattr(rows, name).tobytes() == getattr(others, name).tobytes()
    silence = [end - start for start, end in stream.rows.gaps]
    assert max(silence) == pytest.approx(170.0, abs=6.0)


@pytest.mark.parametrize(("gap", "is_silent"), [(20.0, False), (60.0, True)])
def test_a_short_gap_in_speed_and_power_keeps_its_rows(drive: Frames, gap: float, is_silent: bool) -> None:
    t = drive.t - drive.t[0]
    is_input = np.isin(drive.ident, [CCVS, EEC1])
    traffic = drive[~(is_input & (t > 40.0) & (t < 40.0 + gap))]
    stream = RowStream(from_dict({}))
    parts = rows_of(stream, [traffic])
    assert [type(part) for part in parts] == ([Rows, float, Rows] if is_silent else [Rows])
    assert bool(stream.rows.unusable[SILENT]) == is_silent


def test_a_drive_after_an_hour_of_thin_traffic_is_another_one(drive: Frames) -> None:
    traffic = [moved(drive, START), moved(pairs(drive, 10.0, 360), START + 160.0), moved(drive, START + 3760.0)]
    items = list(RowStream(from_dict({})).feed_all(traffic))
    breaks = [item for item in items if isinstance(item, Interruption)]
    assert [item.is_new_drive for item in breaks] == [True]
    assert items.index(breaks[0]) < len(items) - 1

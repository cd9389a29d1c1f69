"""Many blocks of traffic at once give the same bits as one after the other, whatever is wrong in them."""

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.config import Config
from estimator.samples import Rows
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.row_stream import Block, Interruption, RowStream

pytestmark = pytest.mark.slow

SECONDS = 150.0
TROUBLES = ("thin", "late start", "silence", "pause", "wrong bits", "second sender", "same sender twice", "step back")


@pytest.fixture(scope="module")
def drive() -> Frames:
    rng = np.random.default_rng(1)
    truck = Truck(mass=27_190.0, A=1739.0, C=3.74)
    return frames_of(record(truck, generate_route("mixed", 5000.0, rng), SECONDS, rng).signals)


def troubled(frames: Frames, trouble: str, rng: np.random.Generator) -> Frames:
    """The frames with one more thing wrong, in a group of one identifier and at times that are drawn."""
    start, length = frames.t[0] + rng.uniform(0, SECONDS), rng.uniform(0.5, 60)
    of_group = frames.ident == rng.choice(np.unique(frames.ident))
    then = (frames.t >= start) & (frames.t < start + length)
    if trouble == "thin":
        dropped = of_group.copy()
        dropped[np.flatnonzero(of_group)[:: int(rng.integers(2, 60))]] = False
        return frames[~dropped]
    if trouble == "late start":
        return frames[~(of_group & (frames.t < start))]
    if trouble == "silence":
        return frames[~(of_group & then)]
    if trouble == "pause":
        return replace(frames, t=np.where(frames.t >= start, frames.t + rng.choice([4.0, 20.0, 40.0]), frames.t))
    if trouble == "step back":
        return Frames.concatenate([frames[frames.t < start], frames[frames.t > start - length]])
    hit = np.flatnonzero(of_group & then & (rng.random(len(frames)) < rng.choice([0.02, 0.5, 1.0])))
    if trouble == "wrong bits":
        data = frames.data.copy()
        data[hit] = rng.integers(0, 256, (len(hit), data.shape[1]))
        return replace(frames, data=data)
    added = frames[hit]
    data = added.data.copy()
    data[:, int(rng.integers(0, 8))] ^= np.uint8(rng.integers(0, 64))
    other = added.ident ^ np.uint32(0x21) if trouble == "second sender" else added.ident
    joined = Frames.concatenate([frames, Frames(added.t + 0.001, other, added.length, data)])
    return joined[np.argsort(joined.t, kind="stable")]


def heard(parts: Iterable[Frames]) -> tuple[list[object], RowStream]:
    """All that a stream yields, as bytes, and the stream; blocks are joined up to an interruption or a contest."""
    stream = RowStream(Config())
    items: list[object] = []
    blocks: list[Block] = []
    contested: dict[str, str] = {}
    for item in stream.feed_all(parts):
        if isinstance(item, Interruption) or stream.contested != contested:
            items += [*as_bytes(blocks), item if isinstance(item, Interruption) else dict(stream.contested)]
            blocks, contested = [], dict(stream.contested)
        if isinstance(item, Block):
            blocks.append(item)
    return [*items, *as_bytes(blocks)], stream


def as_bytes(blocks: list[Block]) -> list[object]:
    """Frames, readings and rows of blocks in order, however they are cut."""
    series = defaultdict[tuple[str, int], list[bytes]](list)
    for block in blocks:
        for role, parts in block.readings.items():
            for i, part in enumerate(parts):
                series[role, i] += [t.tobytes() + value.tobytes() for t, value in zip(part.t, part.value, strict=True)]
    found: list[object] = [sum(len(block.frames) for block in blocks), sorted(series.items())]
    if parts := [rows for block in blocks for rows in block.rows]:
        rows = Rows.concatenate(*parts)
        columns = [rows.index, rows.speed, rows.power, rows.fresh, *rows.context.values(), *rows.derived.values()]
        found += [list(rows.context), list(rows.derived), *(column.tobytes() for column in columns)]
    return found


@settings(max_examples=10, deadline=None, derandomize=True)
@given(st.lists(st.sampled_from(TROUBLES), max_size=5), st.integers(0, 2**32 - 1))
def test_many_blocks_at_once_are_as_one_after_the_other(drive: Frames, troubles: list[str], seed: int) -> None:
    rng = np.random.default_rng(seed)
    frames = drive
    for trouble in troubles:
        frames = troubled(frames, trouble, rng)
    step = int(rng.integers(50, 400))  # frames; a block has some 800
    whole, at_once = heard([frames])
    parts, bit_by_bit = heard(frames[i : i + step] for i in range(0, len(frames), step))
    assert whole == parts
    for name in ("errors", "sources", "used", "seen", "newest", "replacements"):
        assert getattr(at_once, name) == getattr(bit_by_bit, name), name
    for name in ("unusable", "gaps", "valid"):
        assert getattr(at_once.rows, name) == getattr(bit_by_bit.rows, name), name


def test_a_quiet_drive_is_decoded_many_blocks_at_once(drive: Frames) -> None:
    blocks = [item for item in RowStream(Config()).feed_all([drive]) if isinstance(item, Block)]
    assert len(blocks) < SECONDS / 5 / 3
    assert sum(len(block.frames) for block in blocks) == len(drive)

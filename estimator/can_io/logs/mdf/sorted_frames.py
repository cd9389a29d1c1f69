"""CAN frames of an ASAM MDF 4 file with one kind of records in each stream."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.can_io.frames import FD_BYTES, Frames
from estimator.can_io.logs.channels import Channels
from estimator.can_io.logs.mdf.blocks import BadMdfError
from estimator.can_io.logs.mdf.frames import Payloads, frames_of, heads, rows_read, valid_rows
from estimator.can_io.logs.mdf.groups import FrameGroup
from estimator.can_io.logs.mdf.records import Numbers, Records, Rows, Scattered, Table, unsigned
from estimator.can_io.logs.mdf.stream import Chunk

ROWS = 1 << 16  # frames made at once
SIZE = np.dtype("<u4")  # before each value of variable length
MAX_WINDOW = 1 << 26  # bytes between the values that frames made at once refer to


def record_count(chunks: Iterator[Chunk], size: int) -> int:
    """Number of whole records of ``size`` bytes in a stream."""
    return sum(len(chunk.raw) for chunk in chunks) // size


class RecordStream:
    """Stream of records of ``size`` bytes, taken in pieces."""

    def __init__(self, chunks: Iterator[Chunk], size: int) -> None:
        self._chunks = chunks
        self._size = size
        self._chunk = Chunk(b"", 0, 0)
        self._count = 0  # records in the chunk
        self._taken = 0
        self._rest: bytes | bytearray = b""  # of a record that goes on in the next chunk
        self.offset = 0  # of the chunk in the file [bytes]

    @property
    def ready(self) -> int:
        """Number of records that can be taken at once, 0 at the end; reads on if there are none.

        Raises
        ------
        BadMdfError
            A block is damaged or cut.
        """
        while self._taken == self._count:
            chunk = next(self._chunks, None)
            if chunk is None:
                return 0
            self._begin(chunk)
        return self._count - self._taken

    def _begin(self, chunk: Chunk) -> None:
        if chunk.columns != self._size or self._rest:
            chunk = Chunk(self._rest + chunk.data(), 0, chunk.offset)
        self._chunk, self._taken, self.offset = chunk, 0, chunk.offset
        self._count = len(chunk.raw) // self._size
        self._rest = chunk.raw[self._count * self._size :]

    def take(self, count: int) -> Records:
        """Take the next records, at most as many as are ready."""
        first, self._taken = self._taken, self._taken + count
        if self._chunk.columns:
            return Table(self._chunk.raw, self._count, first, count)
        return Rows(memoryview(self._chunk.raw)[first * self._size :], self._size, count)


class ValueStream:
    """Values of variable length, each after its size; frames refer to them by offsets that grow from batch to batch.

    ``address`` [bytes] is that of the first block.
    """

    def __init__(self, chunks: Iterator[Chunk], address: int) -> None:
        self._chunks = chunks
        self._address = address
        self._window: bytes | bytearray = b""
        self._start = 0  # offset of the window

    def payloads(self, offsets: Numbers) -> tuple[Payloads, NDArray[np.int64]]:
        """Values at offsets (n,), none before the first of the previous batch, and their sizes (n,) [bytes].

        Raises
        ------
        BadMdfError
            There is no value at an offset, or a block is damaged or cut.
        """
        first, last = int(offsets.min()), int(offsets.max())
        if first < self._start or last - first > MAX_WINDOW:
            where = f"from byte {first} to {last} of their stream, which was read up to {self._start}"
            raise BadMdfError(self._address, f"payloads of neighbouring frames {where}")
        self._advance(first, last + SIZE.itemsize + FD_BYTES)
        end = len(self._window)
        if last - self._start + SIZE.itemsize > end:
            raise BadMdfError(self._address, f"a payload at byte {last} of their stream, which has {self._start + end}")
        at = offsets.astype(np.int64) - self._start
        values = Scattered(self._window + bytes(FD_BYTES), at)
        sizes = values.numbers(0, SIZE.str).astype(np.int64)
        return Payloads(values, SIZE.itemsize, FD_BYTES), np.minimum(sizes, end - SIZE.itemsize - at)

    def _advance(self, first: int, end: int) -> None:
        """Move the window to begin at ``first`` and to reach ``end``, or the end of the stream."""
        parts, reached = [self._window], self._start + len(self._window)
        while reached < end and (chunk := next(self._chunks, None)) is not None:
            if reached <= first:
                parts, self._start = [], reached
            parts.append(chunk.data())
            reached += len(chunk.raw)
        window = b"".join(parts)
        self._window, self._start = window[first - self._start :], min(first, reached)


@dataclass(frozen=True, slots=True, kw_only=True)
class Streams:
    """Streams of a group of frames: its records, and those of times and payloads that lie elsewhere."""

    records: RecordStream
    masters: RecordStream | None
    values: ValueStream | None


def sorted_frames(
    group: FrameGroup,
    streams: Streams,
    channels: Channels,
    count: int | None,
    start: float,
    most: int,
    skipped: Counter[str],
) -> Iterator[Frames]:
    """Yield the frames of a group on the channels that are read, at most ``most`` at a time.

    Parameters
    ----------
    group : FrameGroup
        Layout of the frames.
    streams : Streams
        Streams of the group.
    channels : Channels
        Choice of the channels that are read.
    count : int or None
        Number of frames; None if the file lacks it, for all that follow.
    start : float
        Start of the measurement, from which times count [s].
    most : int
        Largest number of frames in a batch.
    skipped : Counter[str]
        Counts invalid frames.

    Raises
    ------
    BadMdfError
        There are fewer frames, or they are damaged.
    """
    left = count
    while ready := min(streams.records.ready, most if left is None else min(left, most)):
        ready = min(ready, streams.masters.ready) if streams.masters else ready
        if ready == 0:
            raise BadMdfError(streams.records.offset, "CAN frames without times")
        records = streams.records.take(ready)
        masters = streams.masters.take(ready) if streams.masters else records
        sizes: NDArray[np.int64] | int = group.data.bits // 8
        payloads = Payloads(records, group.data.byte, group.data.bits // 8)
        if streams.values is not None:
            payloads, sizes = streams.values.payloads(_offsets(group, records))
        frame_heads, fault = heads(group, records, sizes)
        count = len(frame_heads.ident)
        frames = frames_of(group, frame_heads, masters.first(count), payloads.first(count), start)
        yield frames[rows_read(channels, group, frame_heads, records.first(count), skipped)]
        if fault:
            raise BadMdfError(streams.records.offset, fault)
        left = None if left is None else left - ready
    if left:
        raise BadMdfError(streams.records.offset, f"{left} CAN frames fewer than the file says")


def _offsets(group: FrameGroup, records: Records) -> Numbers:
    """Offsets (n,) of payloads; an invalid frame gets the offset of another one."""
    offsets, valid = unsigned(records, group.data), valid_rows(group, records)
    return offsets if valid is None else np.where(valid, offsets, offsets[np.argmax(valid)])

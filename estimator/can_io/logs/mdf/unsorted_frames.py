"""CAN frames of an ASAM MDF 4 file with records of several kinds in one stream, as loggers write them.

The stream is decoded in pieces. A payload of variable length is a separate record near its frame, before or after it;
the frame has its offset among the values of that kind. Records and payloads that are incomplete at the end of a piece
are decoded with the next one.
"""

from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from estimator.can_io.frames import FD_BYTES, Frames
from estimator.can_io.logs.channels import Channels
from estimator.can_io.logs.mdf.blocks import BadMdfError, UnreadMdfError
from estimator.can_io.logs.mdf.frames import Heads, Payloads, frames_of, heads, rows_read
from estimator.can_io.logs.mdf.groups import DataGroup, FrameGroup
from estimator.can_io.logs.mdf.locate import ROOM, SIZE_BYTES, Located, Places, locate
from estimator.can_io.logs.mdf.records import Numbers, Scattered, unsigned
from estimator.can_io.logs.mdf.stream import Chunk

JOINED = 1 << 20  # bytes that are decoded at once
MAX_INCOMPLETE = 1 << 24  # bytes that wait for a frame or its payload to become complete
NEVER = np.iinfo(np.int64).max  # a place behind every record


class Values(NamedTuple):
    """Values of variable length in a piece: places of their records (n,), sizes (n,) [bytes], and offsets (n + 1,).

    Offsets count from the first value of the stream; the last one is that of the next value.
    """

    at: Places
    sizes: Places
    offsets: Places


class Found(NamedTuple):
    """Readable frames of a group in a piece: places of their records (n,), and of their payloads (n,).

    ``payload_at`` (n,) are places of records: of values with the record id ``values``, or of the frames themselves.
    ``ends_at`` is the place of the first unreadable frame, and ``fault`` its error; empty if its payload may follow.
    """

    group: FrameGroup
    values: int | None
    at: Places
    payload_at: Places
    heads: Heads
    ends_at: int
    fault: str


class Decoded(NamedTuple):
    """Frames at the beginning of a piece, counts of others, the bytes used, and the error found after them."""

    frames: Frames
    skipped: Counter[str]
    used: int
    fault: str


class UnsortedStream:
    """Records of a stream, which may end anywhere if ``is_cut``; their times count from ``start`` [s]."""

    def __init__(
        self, data_group: DataGroup, chunks: Iterator[Chunk], channels: Channels, start: float, is_cut: bool
    ) -> None:
        self._groups = data_group.groups
        self._id_bytes = data_group.id_bytes
        self._chunks = chunks
        self._channels = channels
        self._start = start
        self._is_cut = is_cut
        self._frame_groups = [(group.record_id, group.frames) for group in data_group.groups if group.frames]
        ids = {group.address: group.record_id for group in data_group.groups if group.has_variable_size}
        self._value_ids: dict[int, int] = {}  # record ids of the payloads of groups
        for _, group in self._frame_groups:
            if group.times_at != group.address or (group.data.values and group.data.values not in ids):
                raise UnreadMdfError(group.address, "CAN frames whose times or payloads are in another stream")
            if group.data.values:
                self._value_ids[group.address] = ids[group.data.values]
        self._passed: Counter[int] = Counter()  # bytes of values, by record id

    def frames(self, skipped: Counter[str]) -> Iterator[Frames]:
        """Yield the frames in order of the file; frames without data are counted by kind in ``skipped``.

        Raises
        ------
        BadMdfError
            The stream is damaged or cut; the frames before that are yielded first.
        """
        rest, offset = b"", 0
        for raw, is_last, offset in _pieces(self._chunks):
            data = rest + raw
            decoded = self._decode(data, is_last)
            skipped.update(decoded.skipped)
            yield decoded.frames
            rest = data[decoded.used :]
            if decoded.fault and not (self._is_cut and not rest.strip(b"\0")):
                raise BadMdfError(offset, decoded.fault)
            if decoded.fault:
                return
            if len(rest) > MAX_INCOMPLETE:
                raise BadMdfError(offset, f"a record or payload that is incomplete after {len(rest)} bytes")
        if rest and not self._is_cut:
            raise BadMdfError(offset, "the last record or its payload is incomplete")

    def _decode(self, data: bytes, is_last: bool) -> Decoded:
        """Decode the records at the beginning of ``data``, which ends the stream if ``is_last``."""
        buffer = data + bytes(ROOM)
        located = locate(buffer, self._id_bytes, self._groups)
        values = {number: self._values(buffer, located, number) for number in set(self._value_ids.values())}
        readable = [self._readable(buffer, located, number, group, values) for number, group in self._frame_groups]
        used = _used(readable, values, located, is_last or bool(located.fault))
        for number, group_values in values.items():
            self._passed[number] = int(group_values.offsets[np.searchsorted(group_values.at, used)])
        ids = located.ids[: np.searchsorted(located.at, used)]
        skipped: Counter[str] = Counter()
        for group in self._groups:
            if group.skipped:
                skipped[group.skipped] += int(np.count_nonzero(ids == group.record_id))
        faults = [frames.fault for frames in readable if frames.fault and frames.ends_at == used]
        fault = next(iter(faults), located.fault if used == located.used else "")
        return Decoded(self._frames(buffer, readable, used, skipped), +skipped, used, fault)

    def _values(self, buffer: bytes, located: Located, number: int) -> Values:
        at = located.at[located.ids == number]
        sizes = Scattered(buffer, at).numbers(self._id_bytes, "<u4").astype(np.int64)
        offsets = np.cumsum(np.concatenate(([self._passed[number]], sizes + SIZE_BYTES)))
        return Values(at, sizes, offsets)

    def _readable(
        self, buffer: bytes, located: Located, number: int, group: FrameGroup, values: dict[int, Values]
    ) -> Found:
        at = located.at[located.ids == number]
        value_id = self._value_ids.get(group.address)
        payload_at, sizes, here, fault = at, np.full(len(at), group.data.bits // 8), len(at), ""
        if value_id is not None:
            offsets = unsigned(self._records(buffer, at), group.data)
            payload_at, sizes = _referred(values[value_id], offsets)
            if payload_at.max(initial=0) == NEVER:
                here = int(np.argmax(payload_at))
                is_passed = offsets[here] < values[value_id].offsets[-1]
                fault = f"a payload at byte {offsets[here]} of its stream, where none begins" if is_passed else ""
        frame_heads, wrong = heads(group, self._records(buffer, at[:here]), sizes[:here])
        if wrong:
            here, fault = len(frame_heads.ident), wrong
        ends_at = int(at[here]) if here < len(at) else NEVER
        return Found(group, value_id, at[:here], payload_at[:here], frame_heads, ends_at, fault)

    def _frames(self, buffer: bytes, readable: list[Found], used: int, skipped: Counter[str]) -> Frames:
        """Frames of records before the place ``used``, in order of the file."""
        parts, places = [], []
        for group_frames in readable:
            count = int(np.searchsorted(group_frames.at, used))
            records = self._records(buffer, group_frames.at[:count])
            behind = group_frames.group.data.byte if group_frames.values is None else SIZE_BYTES
            payloads = Payloads(self._records(buffer, group_frames.payload_at[:count]), behind, FD_BYTES)
            read = group_frames.heads.first(count)
            frames = frames_of(group_frames.group, read, records, payloads, self._start)
            rows = rows_read(self._channels, group_frames.group, read, records, skipped)
            parts.append(frames[rows])
            places.append(group_frames.at[:count][rows])
        if len(parts) < 2:
            return Frames.concatenate(parts)
        return Frames.concatenate(parts)[np.argsort(np.concatenate(places), kind="stable")]

    def _records(self, buffer: bytes, at: Places) -> Scattered:
        """Records (n,) without their ids."""
        return Scattered(buffer, at + self._id_bytes)


def _referred(values: Values, offsets: Numbers) -> tuple[Places, Places]:
    """Places (n,) and sizes (n,) [bytes] of the values at offsets (n,); NEVER and 0 if there is none."""
    if np.array_equal(offsets, values.offsets[:-1]):  # the rule: one a frame, in order
        return values.at, values.sizes
    index = np.searchsorted(values.offsets[:-1], offsets.astype(np.int64))
    index[values.offsets[index] != offsets] = len(values.at)
    return np.append(values.at, NEVER)[index], np.append(values.sizes, 0)[index]


def _used(readable: list[Found], values: dict[int, Values], located: Located, is_last: bool) -> int:
    """Place before which every frame has its payload and, unless ``is_last``, every payload its frame."""
    used = min([located.used, *(frames.ends_at for frames in readable)])
    if not is_last:
        for number, every in values.items():
            last = max(int(frames.payload_at.max(initial=-1)) for frames in readable if frames.values == number)
            used = min([used, *every.at[np.searchsorted(every.at, last, "right") :][:1].tolist()])
    while True:
        early = [frames.payload_at[(frames.at >= used) & (frames.payload_at < used)] for frames in readable]
        if not any(map(len, early)):
            return used
        used = min(int(places.min()) for places in early if len(places))


def _pieces(chunks: Iterator[Chunk]) -> Iterator[tuple[bytes, bool, int]]:
    """Yield pieces of a stream, whether each is the last, and its offset in the file.

    Raises
    ------
    BadMdfError
        Raised by ``chunks``; the bytes before it are yielded first.
    """
    held: list[bytes | bytearray] = []
    size, begin = 0, 0
    damage: BadMdfError | None = None
    try:
        for data, offset in _slices(chunks):
            if size + len(data) > JOINED:
                yield b"".join(held), False, begin
                held, size = [], 0
            begin = begin if held else offset
            held.append(data)
            size += len(data)
    except BadMdfError as error:
        damage = error
    if held:
        yield b"".join(held), damage is None, begin
    if damage is not None:
        raise damage


def _slices(chunks: Iterator[Chunk]) -> Iterator[tuple[bytes | bytearray, int]]:
    """Yield bytes of at most the size of a piece, and their offset in the file."""
    for chunk in chunks:
        data = chunk.data()
        for first in range(0, len(data), JOINED):
            yield data[first : first + JOINED], chunk.offset

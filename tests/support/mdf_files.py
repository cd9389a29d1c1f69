"""ASAM MDF 4 bus logs as different writers make them, put together byte by byte, for tests and measurements."""

import struct
import zlib
from dataclasses import dataclass

import numpy as np

START = 1_704_067_200_000_000_000  # ns
FRAME_ID, VALUE_ID, ERROR_ID, REMOTE_ID = 1, 2, 3, 4
HAS_INVALIDATION = 2  # flag of a channel
BUS_EVENT, PLAIN, VALUES, REMOTE_MASTER = 2, 4, 1, 8


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """A data frame, or with ``kind`` "error" or "remote" one without data; ``valid`` needs a style with marks."""

    t: float
    ident: int = 0x18FEF100
    extended: bool = True
    data: bytes = bytes(8)
    kind: str = "data"
    channel: int = 1
    valid: bool = True


@dataclass(frozen=True, kw_only=True)
class Style:
    """How a file is written.

    ``payload`` is "fixed", "values" or "values first"; ``packing`` "plain", "deflated" or "transposed"; ``block`` the
    bytes in a block, 0 for all in one, and each is listed ``times_listed`` times; ``open_flags`` are what is left open;
    ``ticks`` writes times as integers [ns]; ``has_marks`` adds a bit that says that a data frame is none.
    """

    is_sorted: bool = True
    payload: str = "fixed"
    width: int = 64
    packing: str = "plain"
    block: int = 0
    has_header_list: bool = False
    open_flags: int = 0
    ticks: bool = False
    is_column_store: bool = False
    id_bytes: int = 1
    times_listed: int = 1
    has_marks: bool = False


class Writer:
    """Blocks of a file, each placed behind those it links to."""

    def __init__(self, style: Style) -> None:
        self.style = style
        magic = b"UnFinMF " if style.open_flags else b"MDF     "
        head = struct.pack("<8s8s8s4xH30xHH", magic, b"4.11    ", b"test    ", 411, style.open_flags, 0)
        self.raw = bytearray(head + bytes(104))  # and room for the header

    def add(self, kind: bytes, links: list[int], body: bytes) -> int:
        """Place a block; its address."""
        self.raw += bytes(-len(self.raw) % 8)
        address = len(self.raw)
        self.raw += struct.pack("<4s4xQQ", kind, 24 + 8 * len(links) + len(body), len(links))
        self.raw += struct.pack(f"<{len(links)}Q", *links) + body
        return address

    def text(self, text: str) -> int:
        """Place a text; its address."""
        return self.add(b"##TX", [], text.encode() + b"\0")

    def finish(self, data_group: int) -> bytes:
        """The file, given its first group of records."""
        links = [data_group, 0, 0, 0, 0, 0]
        header = struct.pack("<4s4xQQ6QQhhBBBxdd", b"##HD", 104, 6, *links, START, 0, 0, 2, 0, 0, 0.0, 0.0)
        self.raw[64 : 64 + len(header)] = header
        return bytes(self.raw)

    def channel(self, following: int, name: str, place: tuple[int, int, int, int], **more: int) -> int:
        """A channel; ``place`` is the byte, bit, number of bits and type of data."""
        byte, bit, bits, kind = place
        links = [following, more.get("parts", 0), self.text(name), 0, more.get("conversion", 0), more.get("data", 0)]
        body = struct.pack(
            "<BBBBLLLLBxHdddddd",
            more.get("type", 0),
            more.get("sync", 0),
            kind,
            bit,
            byte,
            bits,
            more.get("flags", 0),
            0,
            0,
            0,
            *[0.0] * 6,
        )
        return self.add(b"##CN", [*links, 0, 0], body)

    def stream(self, raw: bytes, columns: int, kind: bytes = b"##DT") -> int:
        """Data in one block, or in a list of them."""
        style = self.style
        pieces = [raw[i : i + style.block] for i in range(0, len(raw), style.block)] if style.block else [raw]
        blocks = [self._block(piece, columns, kind) for piece in pieces]
        if not style.block:
            return blocks[0]
        if kind == b"##DV":
            count = struct.pack("<LLQ", 1, len(blocks), style.block // columns)
            return self.add(b"##LD", [0, *blocks], count)
        following, blocks = 0, [block for block in blocks for _ in range(style.times_listed)]
        for first in reversed(range(0, len(blocks), 3)):
            body = struct.pack("<BxxxLQ", 1, len(blocks[first : first + 3]), style.block)
            following = self.add(b"##DL", [following, *blocks[first : first + 3]], body)
        return self.add(b"##HL", [following], struct.pack("<HB5x", 1, 0)) if style.has_header_list else following

    def _block(self, raw: bytes, columns: int, kind: bytes) -> int:
        if self.style.packing == "plain":
            return self.add(kind, [], raw)
        transposed = self.style.packing == "transposed"
        if transposed:
            rows = len(raw) // columns
            whole = np.frombuffer(raw, np.uint8, rows * columns).reshape(rows, columns).T.tobytes()
            packed = zlib.compress(whole + raw[rows * columns :])
        else:
            packed = zlib.compress(raw)
        head = struct.pack("<2sBxLQQ", kind[2:], transposed, columns if transposed else 0, len(raw), len(packed))
        return self.add(b"##DZ", [], head + packed)


def mdf(frames: list[Recorded], style: Style) -> bytes:
    """A file with the frames in the given order."""
    writer = Writer(style)
    return writer.finish(_sorted(writer, frames) if style.is_sorted else _unsorted(writer, frames))


def _times(writer: Writer, following: int) -> int:
    conversion = 0
    if writer.style.ticks:
        conversion = writer.add(b"##CC", [0, 0, 0, 0], struct.pack("<BBHHHdddd", 1, 0, 0, 0, 2, 0.0, 0.0, 0.0, 1e-9))
    place = (0, 0, 64, 0 if writer.style.ticks else 4)
    return writer.channel(following, "time", place, type=2, sync=1, conversion=conversion)


def _frame_channels(writer: Writer, name: str, values: int, at: int) -> int:
    """Channels as a logger packs them: standard id or not, bus and id in 32 bits, then flags and lengths."""
    style = writer.style
    fields: list[tuple[str, tuple[int, int, int, int]]] = [
        ("IDE", (at, 0, 1, 0)),
        ("BusChannel", (at, 1, 2, 0)),
        ("ID", (at, 3, 29, 0)),
        ("Dir", (at + 4, 0, 1, 0)),
        ("DataLength", (at + 4, 1, 7, 0)),
        ("EDL", (at + 5, 0, 1, 0)),
        ("DLC", (at + 5, 4, 4, 0)),
    ]
    parts = 0
    if name == "CAN_DataFrame":
        if style.payload == "fixed":
            parts = writer.channel(0, f"{name}.DataBytes", (at + 6, 0, 8 * style.width, 10))
        else:
            parts = writer.channel(0, f"{name}.DataBytes", (at + 6, 0, 64, 10), type=1, data=values)
    for field, place in reversed(fields):
        parts = writer.channel(parts, f"{name}.{field}", place)
    size = 8 * (_frame_bytes(style) if name == "CAN_DataFrame" else 6)
    flags = HAS_INVALIDATION if style.has_marks and name == "CAN_DataFrame" else 0
    return writer.channel(0, name, (at, 0, size, 10), parts=parts, flags=flags)


def _group(writer: Writer, following: int, channels: int, number: int, size: int, **more: int) -> int:
    source = writer.add(b"##SI", [0, 0, 0], struct.pack("<BBB5x", 2, 2, 0)) if channels else 0
    links = [following, channels, 0, source, 0, 0]
    flags = more.get("flags", BUS_EVENT | PLAIN)
    if flags & REMOTE_MASTER:
        links.append(more["master"])
    count = 0 if writer.style.open_flags & 1 else more.get("count", 0)
    return writer.add(b"##CG", links, struct.pack("<QQHHxxxxLL", number, count, flags, 0, size, more.get("marks", 0)))


def _mark(style: Style, frame: Recorded) -> bytes:
    return bytes([not frame.valid]) if style.has_marks else b""


def _frame_bytes(style: Style) -> int:
    return 6 + (style.width if style.payload == "fixed" else 8)


def _time(style: Style, frame: Recorded) -> bytes:
    return struct.pack("<Q", round(frame.t * 1e9)) if style.ticks else struct.pack("<d", frame.t)


def _fields(frame: Recorded, payload: bytes) -> bytes:
    first = frame.extended | frame.channel << 1 | frame.ident << 3
    code = len(frame.data) if len(frame.data) <= 8 else (12, 16, 20, 24, 32, 48, 64).index(len(frame.data)) + 9
    return struct.pack("<LBB", first, len(frame.data) << 1, (len(frame.data) > 8) | code << 4) + payload


def _sorted(writer: Writer, frames: list[Recorded]) -> int:
    style = writer.style
    size, offset, values = _frame_bytes(style), 0, []
    records = []
    for frame in (frame for frame in frames if frame.kind == "data"):
        payload = frame.data.ljust(style.width, b"\xee") if style.payload == "fixed" else struct.pack("<Q", offset)
        records.append((_time(style, frame), _fields(frame, payload) + _mark(style, frame)))
        values.append(struct.pack("<L", len(frame.data)) + frame.data)
        offset += 4 + len(frame.data)
    address = 0
    for kind, name in (("remote", "CAN_RemoteFrame"), ("error", "CAN_ErrorFrame")):
        others = [_time(style, frame) + _fields(frame, b"") for frame in frames if frame.kind == kind]
        if others:
            data = writer.stream(b"".join(others), 14)
            group = _group(writer, 0, _times(writer, _frame_channels(writer, name, 0, 8)), 0, 14, count=len(others))
            address = writer.add(b"##DG", [address, group, data, 0], bytes(8))
    stored = 0 if style.payload == "fixed" else writer.stream(b"".join(values), 1, b"##SD")
    if style.is_column_store:
        times = writer.stream(b"".join(t for t, _ in records), 8, b"##DV")
        master = _group(writer, 0, _times(writer, 0), 0, 8, count=len(records), flags=0)
        address = writer.add(b"##DG", [address, master, times, 0], bytes(8))
        data = writer.stream(b"".join(fields for _, fields in records), size, b"##DV")
        channels = _frame_channels(writer, "CAN_DataFrame", stored, 0)
        flags = BUS_EVENT | PLAIN | REMOTE_MASTER
        group = _group(writer, 0, channels, 0, size, count=len(records), flags=flags, master=master)
    else:
        data = writer.stream(b"".join(t + fields for t, fields in records), 8 + size + style.has_marks)
        channels = _times(writer, _frame_channels(writer, "CAN_DataFrame", stored, 8))
        group = _group(writer, 0, channels, 0, 8 + size, count=len(records), marks=style.has_marks)
    return writer.add(b"##DG", [address, group, data, 0], bytes(8))


def _unsorted(writer: Writer, frames: list[Recorded]) -> int:
    style = writer.style
    number = {name: value.to_bytes(style.id_bytes, "little") for name, value in IDS.items()}
    offset, raw = 0, bytearray()
    for frame in frames:
        if frame.kind != "data":
            raw += number[frame.kind] + _time(style, frame) + _fields(frame, b"")
        elif style.payload == "fixed":
            raw += number["data"] + _time(style, frame) + _fields(frame, frame.data.ljust(style.width, b"\xee"))
            raw += _mark(style, frame)
        else:
            record = number["data"] + _time(style, frame) + _fields(frame, struct.pack("<Q", offset))
            record += _mark(style, frame)
            value = number["value"] + struct.pack("<L", len(frame.data)) + frame.data
            raw += record + value if style.payload == "values" else value + record
            offset += 4 + len(frame.data)
    counts = {kind: sum(frame.kind == kind for frame in frames) for kind in IDS}
    following = 0
    for kind, name in (("remote", "CAN_RemoteFrame"), ("error", "CAN_ErrorFrame")):
        channels = _times(writer, _frame_channels(writer, name, 0, 8))
        following = _group(writer, following, channels, IDS[kind], 14, count=counts[kind])
    values = 0
    if style.payload != "fixed":
        values = following = _group(writer, following, 0, VALUE_ID, 0, count=counts["data"], flags=VALUES)
    channels = _times(writer, _frame_channels(writer, "CAN_DataFrame", values, 8))
    size, marks = 8 + _frame_bytes(style), style.has_marks
    group = _group(writer, following, channels, FRAME_ID, size, count=counts["data"], marks=marks)
    links = [0, group, 0, 0]
    address = writer.add(b"##DG", links, struct.pack("<B7x", style.id_bytes))
    data = writer.stream(bytes(raw), 1)
    if style.open_flags & 4 and not style.block and style.packing == "plain":
        writer.raw[data + 8 : data + 16] = struct.pack("<Q", 24)
    writer.raw[address + 40 : address + 48] = struct.pack("<Q", data)
    return address


IDS = {"data": FRAME_ID, "value": VALUE_ID, "error": ERROR_ID, "remote": REMOTE_ID}

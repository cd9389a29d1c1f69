"""Vector BLF logs: a file header, then containers of zlib-packed objects, which may cross container boundaries.

Some writers put objects between the containers, or use no containers.
"""

import struct
from collections.abc import Iterator
from datetime import UTC, datetime
from typing import NamedTuple

from estimator.can_io.frames import Frames
from estimator.can_io.logs.blf_layouts import KINDS
from estimator.can_io.logs.blf_objects import BASE, SIGNATURE, TOO_SMALL, Decoded, decode_objects
from estimator.can_io.logs.inflate import inflate
from estimator.can_io.logs.log import Log
from estimator.can_io.logs.source import Source
from estimator.errors import LogError

MAGIC = b"LOGG"
FILE_HEADER = struct.Struct("<4sL8xQQLL8H8H")  # magic, size; file size, unpacked size, objects; start, stop times
OBJECT_HEADER = struct.Struct("<4sHHLL")  # signature, header size, header version, object size, type
CONTAINER_HEADER = struct.Struct("<H6xL4x")  # method, unpacked size
CONTAINER = 10  # object type
UNPACKED, ZLIB = 0, 2  # methods
JOINED = 1 << 19  # bytes of contents that are decoded at once; more do not fit a processor's cache
MAX_CONTAINER = 1 << 23  # bytes, packed or unpacked (usual: 128 KiB); a larger one is taken for damage
MAX_FILE_HEADER = 1 << 16  # bytes (usual: 144)
FRAME_TYPES = {kind.type for kind in KINDS}


class Header(NamedTuple):
    """File header: size of the file [bytes] and number of objects, both 0 until it is closed, and start [s]."""

    file_size: int
    objects: int
    start: float


class Container(NamedTuple):
    """Available contents of a container, its offset in the file, and the fault in it, if any."""

    data: bytes | bytearray
    offset: int
    fault: str


class BlfLog(Log):
    """Log in ``.blf`` format; times are those of python-can's ``BLFReader``, with its start time in UTC."""

    def _read(self) -> Iterator[Frames]:
        with Source(self.path) as source:
            header = self._read_header(source)
            held: list[Container] = []  # from the start of an object that goes on in the next one
            size, wanted = 0, JOINED  # bytes held, and needed to go on
            count = 0
            for container in self._containers(source):
                held.append(container)
                size += len(container.data)
                if size < wanted and not container.fault:
                    continue
                decoded, left = self._decode(held, header.start)
                held, size, wanted = [left], len(left.data), max(decoded.wanted, JOINED)
                count += len(decoded.frames)
                self.progress = source.consumed
                yield self.channels.keep(decoded.frames, decoded.channel)
                if decoded.fault or container.fault:
                    raise self._damage(left.offset, decoded.fault or container.fault, count, header)
            decoded, left = self._decode(held, header.start)
            count += len(decoded.frames)
            yield self.channels.keep(decoded.frames, decoded.channel)
            if decoded.fault:
                raise self._damage(left.offset, decoded.fault, count, header)
            if left.data.strip(b"\0") or source.position < header.file_size:
                raise self._damage(source.position, "the file ends too early", count, header)

    def _decode(self, held: list[Container], start: float) -> tuple[Decoded, Container]:
        """Decode the objects in some containers; the rest is returned as one container, with the offset of the last."""
        data = b"".join(container.data for container in held)
        decoded = decode_objects(data, start)
        self.skipped.update(decoded.skipped)
        offset, end = 0, 0
        for container in held:
            offset, end = container.offset, end + len(container.data)
            if decoded.fault and decoded.used < end:
                break
        return decoded, Container(data[decoded.used :], offset, "")

    def _containers(self, source: Source) -> Iterator[Container]:
        """Yield the containers up to the end of the file, or to the first damaged one."""
        while True:
            offset = source.position
            data, fault = self._next_container(source)
            if source.position == offset:
                break
            yield Container(data, offset, fault)
            if fault:
                break

    def _read_header(self, source: Source) -> Header:
        raw = source.read(FILE_HEADER.size)
        if not raw.startswith(MAGIC):
            raise LogError(f"{self.path}: not a BLF log (it does not begin with LOGG); check what the file is")
        if len(raw) < FILE_HEADER.size:
            raise LogError(f"{self.path}: cut at byte {len(raw)}, inside the file header; 0 frames can be read")
        _, size, file_size, _, objects, _, *dates = FILE_HEADER.unpack(raw)
        if not FILE_HEADER.size <= size <= MAX_FILE_HEADER:
            raise LogError(f"{self.path}: damaged at byte 4: a file header of {size} bytes; 0 frames can be read")
        source.read(size - FILE_HEADER.size)
        return Header(file_size, objects, start_time(dates[:8]))

    def _next_container(self, source: Source) -> tuple[bytes | bytearray, str]:
        """Read one top-level object: a frame, or the available contents of a container, with its fault."""
        raw = source.read(OBJECT_HEADER.size)
        if not raw:
            return b"", ""
        if len(raw) < OBJECT_HEADER.size:
            return b"", "the file ends in a container's header"
        signature, _, _, size, kind = OBJECT_HEADER.unpack(raw)
        if signature != SIGNATURE:
            return b"", "no container where one should start"
        if not BASE <= size <= MAX_CONTAINER:
            return b"", f"a container of {size} bytes"
        body = source.read(size - BASE)
        cut = "the file ends inside a container" if len(body) < size - BASE else ""
        source.read(size % 4)
        if kind in FRAME_TYPES:
            return raw + body, cut
        if kind != CONTAINER:
            self.skipped[f"BLF object of type {kind} outside a container"] += 1
            return b"", cut
        if len(body) < CONTAINER_HEADER.size:
            return b"", cut or f"a container of {size} bytes"
        method, size = CONTAINER_HEADER.unpack_from(body)
        packed = body[CONTAINER_HEADER.size :]
        if method == UNPACKED:
            return packed, cut
        if method != ZLIB:
            return b"", f"a container packed by the unknown method {method}"
        data, reason = inflate(packed, size, MAX_CONTAINER)
        return data, cut or (f"a container whose packed data {reason}" if reason else "")

    def _damage(self, offset: int, fault: str, frames: int, header: Header) -> LogError:
        unclosed = "its writer never closed it; " if header.objects == 0 else ""
        # At an object that is too small, python-can's converter may never end.
        is_worth_keeping = frames and TOO_SMALL not in fault
        keep = (
            f"to keep those: python -m can.logconvert '{self.path}' repaired.blf"
            if is_worth_keeping
            else "copy it anew"
        )
        return LogError(
            f"{self.path}: damaged or cut at byte {offset} ({fault}) after {frames} frames; {unclosed}{keep}"
        )


def start_time(date: list[int]) -> float:
    """Seconds since 1970 of a SYSTEMTIME (year, month, weekday, day, h, min, s, ms) in UTC; 0 if it is invalid."""
    year, month, _, day, hour, minute, second, millisecond = date
    try:
        return datetime(year, month, day, hour, minute, second, millisecond * 1000, tzinfo=UTC).timestamp()
    except ValueError:
        return 0.0

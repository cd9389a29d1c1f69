"""Layouts of CAN frames in objects of a Vector BLF log, read for whole arrays of objects of one kind.

An object begins with the header ``LOBJ``, header size u16, header version u16, object size u32, type u32. Versions 1
and 2 both have flags u32 at byte 16 and the time u64 at byte 24. Their payload begins at byte 32 or 40. Source:
python-can's ``can.io.blf``.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.can_io.frames import CLASSIC_BYTES, EXTENDED, FD_BYTES, FIRST_BYTES
from estimator.signals import Floats, Mask

PAYLOAD_AT = {1: 32, 2: 40}  # bytes, by header version
TEN_MICROSECONDS = 1  # value of the header's flags; nanoseconds otherwise
TICKS_10US = 1e5  # 1/s
TICKS_1NS = 1e9  # 1/s
IDENT = np.uint32(EXTENDED | 0x1FFFFFFF)

Records = NDArray[np.void]
Fields = dict[str, tuple[str, int]]  # format and offset [bytes]

HEADER: Fields = {"header_size": ("<u2", 4), "size": ("<u4", 8), "stamp": ("<u4", 16), "time": ("<u8", 24)}
CLASSIC: Fields = {"channel": ("<u2", 0), "flags": ("u1", 2), "dlc": ("u1", 3), "id": ("<u4", 4), "data": ("<u8", 8)}
FD: Fields = {"channel": ("<u2", 0), "flags": ("u1", 2), "id": ("<u4", 4), "valid": ("u1", 14), "data": ("64u1", 20)}
FD64: Fields = {
    "channel": ("u1", 0),
    "valid": ("u1", 2),
    "id": ("<u4", 4),
    "flags": ("<u4", 12),
    "end": ("u1", 35),
    "data": ("64u1", 40),
}


class Columns(NamedTuple):
    """Fields of frames as arrays (n,): ``t`` [s], ``data`` (n, 8) or (n, 64), zero beyond ``length`` [bytes].

    ``remote`` frames carry no data; the payload of a ``wrong`` one would lie beyond the end of the object.
    ``channel`` counts from 1.
    """

    t: Floats
    ident: NDArray[np.uint32]
    length: NDArray[np.uint8]
    data: NDArray[np.uint8]
    channel: NDArray[np.unsignedinteger[Any]]
    remote: Mask
    wrong: Mask


class Kind(NamedTuple):
    """Objects of one type and header version, with the layout of their fields.

    ``columns`` makes `Columns` from records, the offset of the payload in them [bytes] and the start of the
    measurement [s].
    """

    type: int
    version: int
    record: np.dtype[np.void]
    columns: Callable[[Records, int, float], Columns]

    def read(self, objects: Records, start: float) -> Columns:
        """Read the frames in records (n,) of this kind."""
        return self.columns(objects, PAYLOAD_AT[self.version], start)


def _classic(objects: Records, payload_at: int, start: float) -> Columns:
    length = np.minimum(objects["dlc"], CLASSIC_BYTES)
    words = np.ascontiguousarray(objects["data"])
    if length.min(initial=CLASSIC_BYTES) < CLASSIC_BYTES:
        words = words & FIRST_BYTES[length]
    data = words.view(np.uint8).reshape(-1, CLASSIC_BYTES)
    wrong = objects["size"] < payload_at + 8 + length.astype(np.uint32)
    remote = objects["flags"] & 0x80 != 0
    return Columns(_times(objects, start), objects["id"] & IDENT, length, data, objects["channel"], remote, wrong)


def _fd(objects: Records, payload_at: int, start: float) -> Columns:
    length = np.minimum(objects["valid"], FD_BYTES)
    data = _first_bytes(objects["data"], length)
    wrong = objects["size"] < payload_at + 20 + length.astype(np.uint32)
    remote = objects["flags"] & 0x80 != 0
    return Columns(_times(objects, start), objects["id"] & IDENT, length, data, objects["channel"], remote, wrong)


def _fd64(objects: Records, payload_at: int, start: float) -> Columns:
    length, size = objects["valid"].copy(), objects["size"]
    end = np.where(objects["end"] > 0, objects["end"], size).astype(np.int64)
    data = _first_bytes(objects["data"], np.minimum(length, end - objects["header_size"] - 40))  # the rest is zeros
    wrong = (size < payload_at + 40) | (length > FD_BYTES)
    remote = objects["flags"] & 0x10 != 0
    return Columns(_times(objects, start), objects["id"] & IDENT, length, data, objects["channel"], remote, wrong)


def _first_bytes(data: NDArray[np.uint8], count: NDArray[np.integer[Any]]) -> NDArray[np.uint8]:
    return np.where(np.arange(FD_BYTES) < count[:, None], data, 0).astype(np.uint8)


def _times(objects: Records, start: float) -> Floats:
    coarse = objects["stamp"] == TEN_MICROSECONDS
    t: Floats = objects["time"] / (np.where(coarse, TICKS_10US, TICKS_1NS) if coarse.any() else TICKS_1NS)
    t += start
    return t


def _record(payload_at: int, fields: Fields) -> "np.dtype[np.void]":
    every = HEADER | {name: (form, payload_at + at) for name, (form, at) in fields.items()}
    formats, offsets = zip(*every.values(), strict=True)
    size = max(at + np.dtype(form).itemsize for form, at in every.values())
    return np.dtype({"names": list(every), "formats": formats, "offsets": offsets, "itemsize": size})


KINDS = tuple(
    Kind(number, version, _record(at, fields), columns)
    for version, at in PAYLOAD_AT.items()
    for number, fields, columns in (
        (1, CLASSIC, _classic),  # CAN_MESSAGE
        (86, CLASSIC, _classic),  # CAN_MESSAGE2
        (100, FD, _fd),  # CAN_FD_MESSAGE
        (101, FD64, _fd64),  # CAN_FD_MESSAGE_64
    )
)
MAX_RECORD_BYTES = max(kind.record.itemsize for kind in KINDS)  # bytes

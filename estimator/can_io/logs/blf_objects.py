"""The objects inside the containers of a Vector BLF log, decoded many at a time.

An object starts with the header ``LOBJ``, header size u16, header version u16, object size u32, type u32; versions 1
and 2 both go on with flags u32 at byte 16 and the time u64 at byte 24, and hold the payload from byte 32 or 40.
Objects follow each other with up to 3 bytes of padding. Layouts as python-can's ``can.io.blf`` reads them.
"""

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from estimator.can_io.frames import CLASSIC_BYTES, EXTENDED, FD_BYTES, Frames
from estimator.can_io.logs.log import ERROR_FRAME, REMOTE_FRAME

SIGNATURE = b"LOBJ"
BASE = 16  # bytes of the header that every object has
HEADER = 32  # bytes of the part that versions 1 and 2 have in common
PAYLOAD_AT = np.array([0, 32, 40])  # bytes, by header version
MAX_PADDING = 4  # bytes between objects, at most
MAX_OBJECT = 1 << 24  # bytes; a larger size is taken for damage

CAN_TYPES = (1, 86)  # CAN_MESSAGE, CAN_MESSAGE2
FD_TYPE = 100  # CAN_FD_MESSAGE
FD64_TYPE = 101  # CAN_FD_MESSAGE_64
ERROR_TYPES = (2, 73, 104)  # CAN_ERROR, CAN_ERROR_EXT, CAN_FD_ERROR_64
LARGEST_PAYLOAD = 40 + FD_BYTES  # bytes of the longest CAN object after its header

TEN_MICROSECONDS = 1  # value of flags; nanoseconds otherwise
TICKS_10US = 1e5  # 1/s
TICKS_1NS = 1e9  # 1/s

CLASSIC = np.dtype({"names": ["flags", "dlc", "id", "data"], "formats": ["u1", "u1", "<u4", "8u1"],
                    "offsets": [2, 3, 4, 8], "itemsize": 16})  # fmt: skip
FD = np.dtype({"names": ["flags", "id", "valid", "data"], "formats": ["u1", "<u4", "u1", "64u1"],
               "offsets": [2, 4, 14, 20], "itemsize": 84})  # fmt: skip
FD64 = np.dtype({"names": ["valid", "id", "flags", "end", "data"], "formats": ["u1", "<u4", "<u4", "u1", "64u1"],
                 "offsets": [2, 4, 12, 35, 40], "itemsize": 104})  # fmt: skip
OBJECT = np.dtype({"names": ["header_size", "version", "size", "type", "flags", "time"],
                   "formats": ["<u2", "<u2", "<u4", "<u4", "<u4", "<u8"],
                   "offsets": [4, 6, 8, 12, 16, 24], "itemsize": HEADER})  # fmt: skip


class Decoded(NamedTuple):
    """The data frames of a stretch of objects, what else was there, the bytes used, and what is wrong after them."""

    frames: Frames
    skipped: Counter[str]
    used: int
    fault: str


def decode_objects(buffer: bytes, start: float) -> Decoded:
    """Decode the complete objects in ``buffer``.

    Parameters
    ----------
    buffer : bytes
        Unpacked contents of containers, from the end of an object on.
    start : float
        Start of the measurement, added to all times [s].
    """
    positions, used, fault = locate(buffer)
    window = np.frombuffer(buffer + bytes(HEADER + LARGEST_PAYLOAD), np.uint8)
    objects = _records(window, positions, OBJECT)
    types = objects["type"]
    known = (objects["version"] == 1) | (objects["version"] == 2)
    body = positions + PAYLOAD_AT[np.where(known, objects["version"], 0)]
    room = positions + objects["size"].astype(np.int64) - body

    count = len(positions)
    ident = np.zeros(count, np.uint32)
    length = np.zeros(count, np.int64)
    need = np.zeros(count, np.int64)  # bytes of payload that the object must have
    remote = np.zeros(count, np.bool_)
    data = np.zeros((count, FD_BYTES if np.isin(types, (FD_TYPE, FD64_TYPE)).any() else CLASSIC_BYTES), np.uint8)

    if len(rows := np.flatnonzero(known & np.isin(types, CAN_TYPES))):
        can = _records(window, body[rows], CLASSIC)
        ident[rows], remote[rows], data[rows, :CLASSIC_BYTES] = can["id"], can["flags"] & 0x80 != 0, can["data"]
        length[rows] = np.minimum(can["dlc"], CLASSIC_BYTES)
        need[rows] = 8 + length[rows]
    if len(rows := np.flatnonzero(known & (types == FD_TYPE))):
        fd = _records(window, body[rows], FD)
        ident[rows], remote[rows], data[rows] = fd["id"], fd["flags"] & 0x80 != 0, fd["data"]
        length[rows] = np.minimum(fd["valid"], FD_BYTES)
        need[rows] = 20 + length[rows]
    if len(rows := np.flatnonzero(known & (types == FD64_TYPE))):
        fd = _records(window, body[rows], FD64)
        end = np.where(fd["end"] > 0, fd["end"], objects["size"][rows]).astype(np.int64)
        present = np.minimum(fd["valid"], end - objects["header_size"][rows] - 40)  # the rest reads as zeros
        ident[rows], remote[rows] = fd["id"], fd["flags"] & 0x10 != 0
        data[rows] = np.where(np.arange(FD_BYTES) < present[:, None], fd["data"], 0)
        length[rows] = fd["valid"]
        need[rows] = 40

    is_frame = known & (np.isin(types, CAN_TYPES) | (types == FD_TYPE) | (types == FD64_TYPE))
    wrong = np.flatnonzero(is_frame & ((room < need) | (length > FD_BYTES)))
    sound = int(wrong[0]) if len(wrong) else count
    if sound < count:
        used, fault = int(positions[sound]), "a CAN frame longer than its object"
    skipped = _count_others(types[:sound], known[:sound], is_frame[:sound])
    skipped[REMOTE_FRAME] += int(np.count_nonzero(remote[:sound]))
    keep = np.flatnonzero((is_frame & ~remote)[:sound])

    ticks = np.where(objects["flags"] == TEN_MICROSECONDS, TICKS_10US, TICKS_1NS)
    t = objects["time"] / ticks + start
    length = length[keep]
    data = data[keep, : FD_BYTES if length.max(initial=0) > CLASSIC_BYTES else CLASSIC_BYTES]
    if length.min(initial=FD_BYTES) < data.shape[1]:
        data = np.where(np.arange(data.shape[1]) < length[:, None], data, 0).astype(np.uint8)
    frames = Frames(t[keep], ident[keep] & np.uint32(EXTENDED | 0x1FFFFFFF), length.astype(np.uint8), data)
    return Decoded(frames, +skipped, used, fault)


def locate(buffer: bytes) -> tuple[NDArray[np.int64], int, str]:
    """Find where the complete objects in ``buffer`` start, up to where the bytes are used, and what is wrong there.

    Where every signature in the bytes is the successor of the one before, they are the objects; from the first
    place where it is not (payload may spell the signature), sizes are followed one by one.
    """
    window = np.frombuffer(buffer, np.uint8)
    at = np.flatnonzero(window[: max(len(window) - BASE + 1, 0)] == SIGNATURE[0])
    for offset in (1, 2, 3):
        at = at[window[at + offset] == SIGNATURE[offset]]
    fast = np.empty(0, np.int64)
    position = 0
    if len(at) and at[0] <= MAX_PADDING:
        sizes = sliding_window_view(window, BASE)[at][:, 8:12].copy().view("<u4")[:, 0].astype(np.int64)
        ends = at + sizes
        follows = np.concatenate(([0], at[1:] - ends[:-1]))
        broken = (follows < 0) | (follows > MAX_PADDING) | (sizes < BASE) | (sizes > MAX_OBJECT)
        broken |= ends > len(buffer)
        sound = int(np.argmax(broken)) if broken.any() else len(at)
        fast = at[:sound].astype(np.int64)
        position = int(ends[sound - 1]) if sound else 0
    slow, used, fault = _walk(buffer, position)
    return np.concatenate((fast, np.array(slow, np.int64))), used, fault


def _walk(buffer: bytes, position: int) -> tuple[list[int], int, str]:
    found: list[int] = []
    reach = MAX_PADDING + len(SIGNATURE)
    while (at := buffer.find(SIGNATURE, position, position + reach)) >= 0 and at + BASE <= len(buffer):
        size = int.from_bytes(buffer[at + 8 : at + 12], "little")
        if not BASE <= size <= MAX_OBJECT:
            return found, position, f"an object of {size} bytes"
        if at + size > len(buffer):
            return found, position, ""
        found.append(at)
        position = at + size
    lost = at < 0 and position + reach <= len(buffer)
    return found, position, "no object where one should start" if lost else ""


def _records(window: NDArray[np.uint8], at: NDArray[np.int64], record: np.dtype[np.void]) -> NDArray[np.void]:
    rows = sliding_window_view(window, record.itemsize)[at]
    return np.ascontiguousarray(rows).view(record)[:, 0]


def _count_others(types: NDArray[np.uint32], known: NDArray[np.bool_], is_frame: NDArray[np.bool_]) -> Counter[str]:
    counts: Counter[str] = Counter()
    counts["BLF object of unknown version"] = int(np.count_nonzero(~known))
    for kind, count in zip(*np.unique(types[known & ~is_frame], return_counts=True), strict=True):
        counts[ERROR_FRAME if kind in ERROR_TYPES else f"BLF object of type {kind}"] += int(count)
    return counts

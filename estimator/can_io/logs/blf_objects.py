"""Objects inside the containers of a Vector BLF log: their positions, and the CAN frames among them.

Objects follow each other with up to 3 bytes of padding. Long runs of objects of one kind and size, as is usual in logs,
are read in place. If kinds are mixed, objects are first located and then gathered by kind.
"""

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from estimator.can_io.frames import CLASSIC_BYTES, FD_BYTES, Frames
from estimator.can_io.logs.blf_layouts import KINDS, MAX_RECORD_BYTES, PAYLOAD_AT, Columns, Kind
from estimator.can_io.logs.channels import Numbers
from estimator.can_io.logs.log import ERROR_FRAME, REMOTE_FRAME
from estimator.signals import Mask

SIGNATURE = b"LOBJ"
BASE = 16  # bytes of the header that every object has: signature, sizes, version and type
TOO_SMALL = ", less than its header takes"
MAX_PADDING = 4  # bytes between objects, at most
MAX_OBJECT = 1 << 22  # bytes; a larger size is taken for damage
MIN_RUN = 64  # objects that are worth to be read as a run
STRETCH = 1 << 17  # bytes in which objects are located at once where kinds are mixed
ERROR_TYPES = (2, 73, 104)  # CAN_ERROR, CAN_ERROR_EXT, CAN_FD_ERROR_64
HEAD = np.dtype([("signature", "<u4"), ("header_size", "<u2"), ("version", "<u2"), ("size", "<u4"), ("type", "<u4")])
NO_CHANNEL = np.empty(0, np.uint16)
KIND_OF = {(kind.type, kind.version): kind for kind in KINDS}


class Decoded(NamedTuple):
    """Data frames (n,) of a stretch of objects, their channels (n,), counts of other objects, and the bytes used.

    ``wanted`` is the known size [bytes] of the next, incomplete object after the used bytes; ``fault`` is the error
    found after them.
    """

    frames: Frames
    channel: Numbers
    skipped: Counter[str]
    used: int
    wanted: int = 0
    fault: str = ""


class Located(NamedTuple):
    """Positions of objects, the number of bytes used, and the error found after them."""

    positions: NDArray[np.int64]
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
    parts: list[Decoded] = []
    skipped: Counter[str] = Counter()
    at, fault = 0, ""
    while not fault and not (wanted := _missing(buffer, at)):
        decoded = _run(buffer, at, start) or _mixed(buffer, at, start)
        parts.append(decoded)
        skipped.update(decoded.skipped)
        at, fault = at + decoded.used, decoded.fault
    parts = [part for part in parts if len(part.frames)] or parts[:1]
    channel = parts[0].channel if len(parts) == 1 else np.concatenate([NO_CHANNEL, *(part.channel for part in parts)])
    frames = Frames.concatenate([part.frames for part in parts])
    return Decoded(frames, channel, skipped, at, 0 if fault else wanted, fault)


def _missing(buffer: bytes, at: int) -> int:
    """Number of bytes from ``at`` on that the next object needs; 0 if they are present, or are not an object."""
    first = buffer.find(SIGNATURE, at, at + MAX_PADDING + len(SIGNATURE))
    if first < 0:
        end = MAX_PADDING + len(SIGNATURE)
    else:
        size = int.from_bytes(buffer[first + 8 : first + 12], "little") if first + BASE <= len(buffer) else BASE
        end = first - at + (size if BASE <= size <= MAX_OBJECT else BASE)
    return 0 if at + end <= len(buffer) else end


def _run(buffer: bytes, at: int, start: float) -> Decoded | None:
    """Decode a run of objects of one kind and size from ``at`` on; None if the run is short."""
    at, offset = buffer.find(SIGNATURE, at, at + MAX_PADDING + len(SIGNATURE)), at
    if at < 0 or at + BASE > len(buffer):
        return None
    head = np.frombuffer(buffer, HEAD, 1, at)[0]
    kind, size = KIND_OF.get((int(head["type"]), int(head["version"]))), int(head["size"])
    if kind is None or size % MAX_PADDING or size < kind.record.itemsize:
        return None
    count = (len(buffer) - at) // size
    heads = np.ndarray((count, 2), "<u8", buffer, at, (size, 8))
    same = ((heads[:, 0] == heads[0, 0]) & (heads[:, 1] == heads[0, 1])) if count else np.ones(0, np.bool_)
    if not same.all():
        count = int(np.argmin(same))
    if count < MIN_RUN:
        return None
    columns = kind.read(np.ndarray(count, kind.record, buffer, at, (size,)), start)
    if columns.wrong.any():
        return None
    remote = int(np.count_nonzero(columns.remote))
    return _decoded(
        columns, ~columns.remote if remote else None, Counter({REMOTE_FRAME: remote}), at + count * size - offset
    )


def _decoded(columns: Columns, keep: Mask | None, skipped: Counter[str], used: int, fault: str = "") -> Decoded:
    """Select the objects in the mask ``keep`` (n,), all if it is None."""
    frames, channel = Frames(columns.t, columns.ident, columns.length, columns.data), columns.channel
    if keep is not None:
        frames, channel = frames[keep], channel[keep]
    if frames.data.shape[1] > CLASSIC_BYTES >= frames.length.max(initial=0):
        frames = Frames(frames.t, frames.ident, frames.length, frames.data[:, :CLASSIC_BYTES].copy())
    return Decoded(frames, channel, +skipped, used, fault=fault)


def _mixed(buffer: bytes, at: int, start: float) -> Decoded:
    """Decode the objects of any kind in a stretch from ``at`` on."""
    stretch = buffer[at : at + STRETCH]
    located = locate(stretch)
    if not len(located.positions) and not located.fault and at + STRETCH < len(buffer):  # a large object
        stretch = buffer[at:]
        located = locate(stretch)
    window = np.frombuffer(stretch + bytes(MAX_RECORD_BYTES), np.uint8)
    heads = _gathered(window, located.positions, HEAD)
    columns = _blank(len(heads), bool(np.isin(heads["type"], (100, 101)).any()))
    is_frame = np.zeros(len(heads), np.bool_)
    for kind in KINDS:
        rows = np.flatnonzero((heads["type"] == kind.type) & (heads["version"] == kind.version))
        if len(rows):
            is_frame[rows] = True
            _put(columns, rows, kind, _gathered(window, located.positions[rows], kind.record), start)
    wrong = np.flatnonzero(columns.wrong)
    sound = int(wrong[0]) if len(wrong) else len(heads)
    skipped = _count_others(heads[:sound], is_frame[:sound])
    skipped[REMOTE_FRAME] += int(np.count_nonzero(columns.remote[:sound]))
    keep = is_frame & ~columns.remote
    keep[sound:] = False
    used, fault = located.used, located.fault
    if sound < len(heads):
        used, fault = int(located.positions[sound]), "a CAN frame longer than its object"
    return _decoded(columns, keep, skipped, used, fault)


def _blank(count: int, has_fd: bool) -> Columns:
    data = np.zeros((count, FD_BYTES if has_fd else CLASSIC_BYTES), np.uint8)
    return Columns(
        t=np.zeros(count),
        ident=np.zeros(count, np.uint32),
        length=np.zeros(count, np.uint8),
        data=data,
        channel=np.zeros(count, np.uint16),
        remote=np.zeros(count, np.bool_),
        wrong=np.zeros(count, np.bool_),
    )


def _put(columns: Columns, rows: NDArray[np.intp], kind: Kind, objects: NDArray[np.void], start: float) -> None:
    read = kind.read(objects, start)
    columns.data[rows, : read.data.shape[1]] = read.data
    for name in ("t", "ident", "length", "channel", "remote", "wrong"):
        getattr(columns, name)[rows] = getattr(read, name)


def locate(buffer: bytes) -> Located:
    """Find where the complete objects in ``buffer`` start.

    The signatures are the objects as long as each follows from the size of the previous object. From the first that
    does not (a payload may contain the signature), sizes are followed one by one.
    """
    window = np.frombuffer(buffer, np.uint8)
    at = np.flatnonzero(window[: max(len(window) - BASE + 1, 0)] == SIGNATURE[0])
    for offset in (1, 2, 3):
        at = at[window[at + offset] == SIGNATURE[offset]]
    fast = np.empty(0, np.int64)
    position = 0
    if len(at) and at[0] <= MAX_PADDING:
        sizes = _gathered(window, at, HEAD)["size"].astype(np.int64)
        ends = at + sizes
        follows = np.concatenate(([0], at[1:] - ends[:-1]))
        broken = (follows < 0) | (follows > MAX_PADDING) | (sizes < BASE) | (sizes > MAX_OBJECT)
        broken |= ends > len(buffer)
        sound = int(np.argmax(broken)) if broken.any() else len(at)
        fast = at[:sound].astype(np.int64)
        position = int(ends[sound - 1]) if sound else 0
    rest = _walk(buffer, position)
    return rest._replace(positions=np.concatenate((fast, rest.positions)))


def _walk(buffer: bytes, position: int) -> Located:
    """Follow the sizes of objects, one by one."""
    positions: list[int] = []
    fault = ""
    reach = MAX_PADDING + len(SIGNATURE)
    while (at := buffer.find(SIGNATURE, position, position + reach)) >= 0 and at + BASE <= len(buffer):
        size = int.from_bytes(buffer[at + 8 : at + 12], "little")
        if not BASE <= size <= MAX_OBJECT:
            fault = f"an object of {size} bytes{TOO_SMALL * (size < BASE)}"
        if fault or at + size > len(buffer):
            break
        positions.append(at)
        position = at + size
    if at < 0 and position + reach <= len(buffer):
        fault = "no object where one should start"
    return Located(np.array(positions, np.int64), position, fault)


def _gathered(window: NDArray[np.uint8], at: NDArray[np.int64], record: np.dtype[np.void]) -> NDArray[np.void]:
    """Records (n,) that start at the positions ``at`` (n,) of a window."""
    rows = sliding_window_view(window, record.itemsize)[at]
    return np.ascontiguousarray(rows).view(record)[:, 0]


def _count_others(heads: NDArray[np.void], is_frame: Mask) -> Counter[str]:
    is_known = np.isin(heads["version"], list(PAYLOAD_AT))
    counts: Counter[str] = Counter()
    counts["BLF object of unknown version"] = int(np.count_nonzero(~is_known))
    for kind, count in zip(*np.unique(heads["type"][is_known & ~is_frame], return_counts=True), strict=True):
        counts[ERROR_FRAME if kind in ERROR_TYPES else f"BLF object of type {kind}"] += int(count)
    return counts

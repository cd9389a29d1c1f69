"""CAN frames in records of an ASAM MDF 4 file."""

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.can_io.frames import CLASSIC_BYTES, FD_BYTES, FIRST_BYTES, Frames
from estimator.can_io.logs.channels import UNNAMED, Channels
from estimator.can_io.logs.mdf.groups import FrameGroup
from estimator.can_io.logs.mdf.records import Bytes, Records, times, unsigned
from estimator.signals import Mask

ID_BITS = np.uint32(0x1FFFFFFF)
MAX_STANDARD_ID = 0x7FF
INVALID = "frame marked as invalid"


class Payloads(NamedTuple):
    """Location of the payloads of frames (n,): ``records``, first ``byte``, and number ``room`` of readable bytes."""

    records: Records
    byte: int
    room: int

    def first(self, count: int) -> "Payloads":
        """Payloads of the first ``count`` frames."""
        return Payloads(self.records.first(count), self.byte, self.room)


class Heads(NamedTuple):
    """Ids (n,) with bit 31 set if they have 29 bits, lengths (n,) [bytes], and mask ``valid`` (n,), None for all."""

    ident: NDArray[np.uint32]
    length: NDArray[np.uint8]
    valid: Mask | None = None

    def first(self, count: int) -> "Heads":
        """Ids and lengths of the first ``count`` frames."""
        return Heads(self.ident[:count], self.length[:count], None if self.valid is None else self.valid[:count])


def valid_rows(group: FrameGroup, records: Records) -> Mask | None:
    """Mask (n,) of frames without a value marked as invalid; None if it is True for all."""
    valid = np.ones(len(records), np.bool_)
    for bit in group.invalid:
        valid &= unsigned(records, bit) == 0
    return None if valid.all() else valid


def heads(group: FrameGroup, records: Records, sizes: NDArray[np.int64] | int) -> tuple[Heads, str]:
    """Read ids and lengths of frames (n,); ``sizes`` (n,) or scalar [bytes] is the room for each payload.

    Returns
    -------
    tuple[Heads, str]
        Heads of the frames before the first impossible one, and the error of that frame.
    """
    length = unsigned(records, group.length)
    raw = unsigned(records, group.ident).astype(np.uint32)
    # Without a channel for it, the id's top bit says that it has 29 bits.
    flag = (raw >> np.uint32(31)).astype(np.bool_)
    extended = flag if group.extended is None else unsigned(records, group.extended).astype(np.bool_)
    ident = raw & ID_BITS
    wrong = (length > np.minimum(sizes, FD_BYTES)) | ((ident > MAX_STANDARD_ID) & ~extended)
    valid = valid_rows(group, records)
    if valid is not None:
        wrong &= valid
        length = np.where(valid, length, 0)
    count, fault = len(records), ""
    if wrong.any():
        count = int(np.argmax(wrong))
        fault = f"a CAN frame with the id {ident[count]:X} and {length[count]} data bytes"
    ident |= extended.astype(np.uint32) << np.uint32(31)
    return Heads(ident, length.astype(np.uint8), valid).first(count), fault


def frames_of(group: FrameGroup, head: Heads, masters: Records, payloads: Payloads, start: float) -> Frames:
    """Frames (n,) with times from the records ``masters`` (n,), counted from ``start`` [s]."""
    return Frames(times(masters, group.times, start), head.ident, head.length, _data(payloads, head.length))


def rows_read(
    channels: Channels, group: FrameGroup, head: Heads, records: Records, skipped: Counter[str]
) -> slice | Mask:
    """Mask (n,) or slice of the valid frames of read channels in ``records`` (n,); others are counted."""
    number = np.zeros(len(records), np.uint8) if group.channel is None else unsigned(records, group.channel)
    name = str if group.channel is not None else lambda _: UNNAMED
    if head.valid is None:
        return channels.rows(head.ident, number, name)
    rows = head.valid.copy()
    skipped[INVALID] += int(np.count_nonzero(~rows))
    read = np.zeros(np.count_nonzero(rows), np.bool_)
    read[channels.rows(head.ident[rows], number[rows], name)] = True
    rows[rows] = read
    return rows


def _data(payloads: Payloads, length: NDArray[np.uint8]) -> Bytes:
    """Payloads (n, 8) or (n, 64), zero beyond their length."""
    longest = int(length.max(initial=0))
    if longest <= CLASSIC_BYTES <= payloads.room:
        words = np.ascontiguousarray(payloads.records.numbers(payloads.byte, "<u8"))
        if length.min(initial=CLASSIC_BYTES) < CLASSIC_BYTES:
            words = words & FIRST_BYTES[length]
        return words.view(np.uint8).reshape(-1, CLASSIC_BYTES)
    width = CLASSIC_BYTES if longest <= CLASSIC_BYTES else FD_BYTES
    data = np.zeros((len(length), width), np.uint8)
    taken = min(payloads.room, width)
    data[:, :taken] = payloads.records.bytes_at(payloads.byte, taken)
    data[np.arange(width) >= length[:, None]] = 0
    return data

"""J1939: parameter group numbers, values that are no values, and multi-packet broadcasts.

Source: SAE J1939-21 (identifiers, transport protocol) and J1939-71 table 1 (value ranges).
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from estimator.can_io.frames import CLASSIC_BYTES, EXTENDED, Frames
from estimator.signals import Floats, Mask

PDU1_LIMIT = 0xF0  # PDU formats below address one node: their low byte is a destination, not part of the PGN
TP_CM = 0xEC00  # transport protocol, connection management
TP_DT = 0xEB00  # transport protocol, data transfer
BAM = 0x20  # control byte: broadcast announce message
ABORT = 0xFF  # control byte: connection abort
GLOBAL = 0xFF  # destination address of a broadcast
T1 = 0.75  # s between packets after which a receiver gives up (J1939-21, 5.13.3)
PACKET_BYTES = 7  # payload of a data packet after its sequence number
GROUP_MASK = EXTENDED | 0x3FFFF00  # of an id: all but priority and source
ANNOUNCEMENT = EXTENDED | (TP_CM | GLOBAL) << 8
PACKET = EXTENDED | (TP_DT | GLOBAL) << 8
BROADCAST = EXTENDED | (0xE800 | GLOBAL) << 8  # both of these, and of six groups beside them
BROADCAST_MASK = GROUP_MASK & ~0x70000
MIN_AT_ONCE = 32  # frames of the protocol that are worth to be looked at together
MAX_BYTES = 255 * PACKET_BYTES  # of a message: its packets are numbered from 1 to 255 (J1939-21)


def pgn_of(ident: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Parameter group number of 29-bit ids (n,)."""
    pdu2 = (ident >> 16 & 0xFF) >= PDU1_LIMIT
    return np.where(pdu2, ident >> 8 & 0x3FFFF, ident >> 8 & 0x3FF00).astype(np.uint32)


def highest_valid(length: int) -> int:
    """The highest raw value of ``length`` bits that is valid, see `classify`."""
    if length >= 8:
        return (0xFB << length - 8) - 1
    return (1 << length) - (3 if length in (2, 4) else 1)


def classify(raw: NDArray[np.uint64], length: int) -> tuple[Mask, Mask, Mask]:
    """Which raw values (n,) of ``length`` bits mean "not available", "error", or are reserved; three masks (n,).

    Numbers of a byte and more are valid while their top byte is at most 0xFA; 4-bit and 2-bit fields have the
    last two codes. Other widths carry no special values.
    """
    no = np.zeros(len(raw), dtype=bool)
    if length >= 8:
        top = raw >> np.uint64(length - 8) & np.uint64(0xFF)
        return top == 0xFF, top == 0xFE, (top > 0xFA) & (top < 0xFE)
    if length in (2, 4):
        last = (1 << length) - 1
        return raw == last, raw == last - 1, no
    return no, no, no


@dataclass(slots=True, kw_only=True)
class _Session:
    pgn: int
    size: int
    packets: int
    t: float
    payload: bytearray = field(default_factory=bytearray)
    received: int = 0


@dataclass(frozen=True, slots=True)
class MultiPacket:
    """A message of more than 8 bytes, complete at time ``t`` [s]."""

    t: float
    pgn: int
    source: int
    payload: bytes


class Transport:
    """Reassembles broadcasts (BAM); one at a time per source, several sources may interleave.

    A broken broadcast is dropped whole; ``rejected`` counts why.
    """

    def __init__(self) -> None:
        self.rejected: Counter[str] = Counter()
        self._sessions: dict[int, _Session] = {}

    def feed(self, frames: Frames) -> list[MultiPacket]:
        """Messages that these frames complete; frames that are not of the transport protocol are passed over."""
        # Broadcasts only: the destination byte of the id is the global address.
        rows = np.flatnonzero(frames.ident & np.uint32(BROADCAST_MASK) == BROADCAST)
        group = frames.ident[rows] & np.uint32(GROUP_MASK)
        is_known = ((group == ANNOUNCEMENT) | (group == PACKET)) & (frames.length[rows] >= CLASSIC_BYTES)
        if not is_known.all():
            short = ((group == ANNOUNCEMENT) | (group == PACKET)) & ~is_known
            self.rejected["transport: short frame"] += int(np.count_nonzero(short))
            rows, group = rows[is_known], group[is_known]
        t, source, data = frames.t[rows], frames.ident[rows] & np.uint32(0xFF), frames.data[rows, :CLASSIC_BYTES]
        opens = group == ANNOUNCEMENT
        whole, left = _whole_broadcasts(t, source, opens, data) if len(rows) >= MIN_AT_ONCE else ({}, range(len(rows)))
        payload, times, sources, is_opening = data.tobytes(), t.tolist(), source.tolist(), opens.tolist()
        messages: list[tuple[int, MultiPacket]] = []
        for i in left:
            if i in whole:
                self._break_off(sources[i])
                messages.append(whole[i])
            elif is_opening[i]:
                self._open(times[i], sources[i], payload[CLASSIC_BYTES * i : CLASSIC_BYTES * (i + 1)])
            elif found := self._extend(times[i], sources[i], payload[CLASSIC_BYTES * i : CLASSIC_BYTES * (i + 1)]):
                messages.append((i, found))
        return [message for _, message in sorted(messages, key=itemgetter(0))]

    def _break_off(self, source: int) -> None:
        if self._sessions.pop(source, None) is not None:
            self.rejected["transport: broken off"] += 1

    def _open(self, t: float, source: int, data: bytes) -> None:
        if data[0] not in (BAM, ABORT):
            return
        self._break_off(source)
        if data[0] == ABORT:
            return
        size, packets = int.from_bytes(data[1:3], "little"), data[3]
        if not 8 < size <= MAX_BYTES or packets != -(-size // PACKET_BYTES):
            self.rejected["transport: impossible announcement"] += 1
            return
        self._sessions[source] = _Session(pgn=int.from_bytes(data[5:8], "little"), size=size, packets=packets, t=t)

    def _extend(self, t: float, source: int, data: bytes) -> MultiPacket | None:
        session = self._sessions.get(source)
        if session is None:
            return None
        number = data[0]
        if 0 < number == session.received and session.payload.endswith(data[1:]):
            self.rejected["transport: packet repeated"] += 1
            return None
        if not 0 <= t - session.t <= T1 or number != session.received + 1:
            self.rejected["transport: packet late or lost"] += 1
            del self._sessions[source]
            return None
        session.t, session.received = t, number
        session.payload += data[1:]
        if number < session.packets:
            return None
        del self._sessions[source]
        return MultiPacket(t, session.pgn, source, bytes(session.payload[: session.size]))


def _whole_broadcasts(
    t: Floats, source: NDArray[np.uint32], opens: Mask, data: NDArray[np.uint8]
) -> tuple[dict[int, tuple[int, MultiPacket]], Sequence[int]]:
    """Broadcasts without a fault, by the place of their announcement; and the places that are not inside one.

    With each message comes the place of its last packet. Frames (n,) have times ``t`` [s] and payloads ``data`` (n, 8);
    those that open a broadcast are announcements, the others packets.
    """
    order = np.argsort(source, kind="stable")
    t, source, opens, data = t[order], source[order], opens[order], data[order]
    words = np.ascontiguousarray(data).view("<u8")[:, 0]
    number = np.where(opens, 0, data[:, 0].astype(np.intp))
    step = np.diff(t)
    goes_on = ~opens[1:] & (source[1:] == source[:-1]) & (number[1:] == number[:-1] + 1) & (step >= 0) & (step <= T1)
    breaks = np.concatenate([[0], np.cumsum(~goes_on)])
    first = np.flatnonzero(opens & (data[:, 0] == BAM))
    size, packets = (words[first] >> np.uint64(8) & np.uint64(0xFFFF)).astype(np.intp), data[first, 3].astype(np.intp)
    last = first + packets
    good = (size > CLASSIC_BYTES) & (size <= MAX_BYTES) & (packets == -(-size // PACKET_BYTES)) & (last < len(t))
    first, last, size = first[good], last[good], size[good]
    good = breaks[last] == breaks[first]
    first, last, size = first[good], last[good], size[good]
    inside = np.zeros(len(t) + 1, np.intp)
    inside[first + 1] += 1
    inside[last + 1] -= 1
    left = np.sort(order[np.cumsum(inside[:-1]) == 0])
    payload, pgn = data[:, 1:].tobytes(), (words[first] >> np.uint64(40)).tolist()
    each = zip(
        order[first].tolist(), order[last].tolist(), first.tolist(), size.tolist(), t[last].tolist(), pgn,
        source[first].tolist(), strict=True,
    )  # fmt: skip
    whole = {}
    for place, end, at, length, when, group, address in each:
        begin = PACKET_BYTES * (at + 1)
        whole[place] = end, MultiPacket(when, group, address, payload[begin : begin + length])
    return whole, left.tolist()

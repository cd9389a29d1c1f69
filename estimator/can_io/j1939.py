"""J1939: parameter group numbers, raw values with a special meaning, and multi-packet messages.

Source: SAE J1939-21 (identifiers, transport protocol) and J1939-71 table 1 (value ranges).
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from estimator.can_io.frames import CLASSIC_BYTES, EXTENDED, Frames
from estimator.signals import Floats, Mask

PDU1_LIMIT = 0xF0  # PDU formats below address one node: their low byte is a destination, not part of the PGN
TP_CM = 0xEC00  # transport protocol, connection management
TP_DT = 0xEB00  # transport protocol, data transfer
BAM = 0x20  # control byte: broadcast announce message
RTS, CTS, END_OF_MESSAGE = 0x10, 0x11, 0x13  # control bytes: request to send, clear to send, acknowledgement
ABORT = 0xFF  # control byte: connection abort
GLOBAL = 0xFF  # destination address of a broadcast
T1 = 0.75  # s between packets after which a receiver gives up (J1939-21, 5.13.3)
T2 = 1.25  # s after a CTS until the first packet that it allows; T4, of a CTS that allows none, is shorter
PACKET_BYTES = 7  # payload of a data packet after its sequence number
GROUP_MASK = EXTENDED | 0x3FFFF00  # of an id: all but priority and source
FORMAT_MASK = GROUP_MASK & ~0xFF00  # and but the destination
ANNOUNCEMENT, PACKET = EXTENDED | TP_CM << 8, EXTENDED | TP_DT << 8
NEAR = EXTENDED | 0xE800 << 8  # both of these, and six groups beside them
NEAR_MASK = FORMAT_MASK & ~0x70000
MIN_AT_ONCE = 32  # frames of the protocol that are worth to be looked at together
MAX_BYTES = 255 * PACKET_BYTES  # of a message: its packets are numbered from 1 to 255 (J1939-21)


def pgn_of(ident: NDArray[np.uint32]) -> NDArray[np.uint32]:
    """Parameter group number of 29-bit ids (n,)."""
    pdu2 = (ident >> 16 & 0xFF) >= PDU1_LIMIT
    return np.where(pdu2, ident >> 8 & 0x3FFFF, ident >> 8 & 0x3FF00).astype(np.uint32)


def highest_valid(length: int) -> int:
    """Highest valid raw value of ``length`` bits, see `classify`."""
    if length >= 8:
        return (0xFB << length - 8) - 1
    return (1 << length) - (3 if length in (2, 4) else 1)


def classify(raw: NDArray[np.uint64], length: int) -> tuple[Mask, Mask, Mask]:
    """Masks (n,) of raw values (n,) of ``length`` bits: not available, error, reserved.

    Numbers of a byte and more are valid while their top byte is at most 0xFA. In 4-bit and 2-bit fields the last two
    codes are special. Other widths have no special values.
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
    destination: int
    size: int
    packets: int
    t: float
    until: float  # [s] by which the next packet has to come
    payload: bytearray = field(default_factory=bytearray)
    received: int = 0


@dataclass(frozen=True, slots=True)
class MultiPacket:
    """Message of more than 8 bytes, complete at time ``t`` [s]."""

    t: float
    pgn: int
    source: int
    payload: bytes
    _: KW_ONLY
    destination: int = GLOBAL


class Transport:
    """Reassembles messages to all nodes (BAM) and, as a listener, those to one node (RTS and CTS).

    A source has one message of either kind at a time; several sources may interleave. A broken message is dropped
    whole, and counted by reason in ``rejected``.
    """

    def __init__(self) -> None:
        self.rejected: Counter[str] = Counter()
        self._sessions: dict[tuple[int, bool], _Session] = {}  # by source, and whether to all

    def feed(self, frames: Frames) -> list[MultiPacket]:
        """Return the messages that these frames complete; frames of other protocols are ignored."""
        rows = np.flatnonzero(frames.ident & np.uint32(NEAR_MASK) == NEAR)
        group = frames.ident[rows] & np.uint32(FORMAT_MASK)
        is_known = ((group == ANNOUNCEMENT) | (group == PACKET)) & (frames.length[rows] >= CLASSIC_BYTES)
        if not is_known.all():
            short = ((group == ANNOUNCEMENT) | (group == PACKET)) & ~is_known
            self.rejected["transport: short frame"] += int(np.count_nonzero(short))
            rows, group = rows[is_known], group[is_known]
        t, ident, data = frames.t[rows], frames.ident[rows], frames.data[rows, :CLASSIC_BYTES]
        opens = group == ANNOUNCEMENT
        whole, left = _whole_messages(t, ident, opens, data) if len(rows) >= MIN_AT_ONCE else ({}, range(len(rows)))
        payload, times, idents, is_opening = data.tobytes(), t.tolist(), ident.tolist(), opens.tolist()
        messages: list[tuple[int, MultiPacket]] = []
        for i in left:
            source, destination = idents[i] & 0xFF, idents[i] >> 8 & 0xFF
            packet = payload[CLASSIC_BYTES * i : CLASSIC_BYTES * (i + 1)]
            if i in whole:
                self._break_off(source, destination)
                messages.append(whole[i])
            elif is_opening[i]:
                self._manage(times[i], source, destination, packet)
            elif complete := self._extend(times[i], source, destination, packet):
                messages.append((i, complete))
        return [message for _, message in sorted(messages, key=itemgetter(0))]

    def _break_off(self, source: int, destination: int) -> None:
        if self._sessions.pop((source, destination == GLOBAL), None) is not None:
            self.rejected["transport: broken off"] += 1

    def _manage(self, t: float, source: int, destination: int, data: bytes) -> None:
        """Process a frame of connection management; from receivers, only "wait" and "go on" count."""
        pgn = int.from_bytes(data[5:8], "little")
        if data[0] == CTS:
            session = self._sessions.get((destination, False))
            if session is not None and (session.destination, session.pgn) == (source, pgn):
                session.until = max(session.until, t + T2)
            return
        if data[0] != ABORT and data[0] != (BAM if destination == GLOBAL else RTS):
            return
        self._break_off(source, destination)
        if data[0] == ABORT:
            return
        size, packets = int.from_bytes(data[1:3], "little"), data[3]
        if not 8 < size <= MAX_BYTES or packets != -(-size // PACKET_BYTES):
            self.rejected["transport: impossible announcement"] += 1
            return
        until = t + (T1 if destination == GLOBAL else T2)
        self._sessions[source, destination == GLOBAL] = _Session(
            pgn=pgn, destination=destination, size=size, packets=packets, t=t, until=until
        )

    def _extend(self, t: float, source: int, destination: int, data: bytes) -> MultiPacket | None:
        key = source, destination == GLOBAL
        session = self._sessions.get(key)
        if session is None or session.destination != destination:
            return None
        number = data[0]
        if 0 < number <= session.received and session.payload.startswith(data[1:], PACKET_BYTES * (number - 1)):
            self.rejected["transport: packet repeated"] += 1
            return None
        if not session.t <= t <= session.until or number != session.received + 1:
            self.rejected["transport: packet late or lost"] += 1
            del self._sessions[key]
            return None
        session.t, session.until, session.received = t, t + T1, number
        session.payload += data[1:]
        if number < session.packets:
            return None
        del self._sessions[key]
        return MultiPacket(t, session.pgn, source, bytes(session.payload[: session.size]), destination=destination)


def _whole_messages(
    t: Floats, ident: NDArray[np.uint32], opens: Mask, data: NDArray[np.uint8]
) -> tuple[dict[int, tuple[int, MultiPacket]], Sequence[int]]:
    """Complete messages, each with the index of its last packet, by the index of its announcement; other indices.

    Frames (n,) have times ``t`` [s] and payloads ``data`` (n, 8). Frames that open a message are of connection
    management, the others are packets.
    """
    to = ident >> 8 & 0xFF
    order = np.argsort((ident & 0xFF) << 1 | (to == GLOBAL), kind="stable")
    t, ident, to, opens, data = t[order], ident[order], to[order], opens[order], data[order]
    words = np.ascontiguousarray(data).view("<u8")[:, 0]
    number = np.where(opens, 0, data[:, 0].astype(np.intp))
    step, pair = np.diff(t), ident & 0xFFFF
    goes_on = ~opens[1:] & (pair[1:] == pair[:-1]) & (number[1:] == number[:-1] + 1) & (step >= 0) & (step <= T1)
    breaks = np.concatenate([[0], np.cumsum(~goes_on)])
    first = np.flatnonzero(opens & (data[:, 0] == np.where(to == GLOBAL, BAM, RTS)))
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
    fields = zip(
        order[first].tolist(), order[last].tolist(), first.tolist(), size.tolist(), t[last].tolist(), pgn,
        (ident[first] & 0xFF).tolist(), to[first].tolist(), strict=True,
    )  # fmt: skip
    whole = {}
    for head, end, at, length, when, group, source, destination in fields:
        begin = PACKET_BYTES * (at + 1)
        whole[head] = end, MultiPacket(when, group, source, payload[begin : begin + length], destination=destination)
    return whole, left.tolist()

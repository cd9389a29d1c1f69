"""Sending of J1939 messages of more than 8 bytes (SAE J1939-21, 5.10), to all by BAM or to one node by RTS and CTS.

One broadcast, and one connection with each of a few nodes, run at a time, as J1939-21 demands. Data packets are sent
singly, 50 ms apart, which is the least that J1939-21 allows in a broadcast.
"""

from dataclasses import dataclass

import can

from estimator.can_io.frames import CLASSIC_BYTES
from estimator.can_io.j1939 import (
    ABORT,
    BAM,
    CTS,
    END_OF_MESSAGE,
    GLOBAL,
    MAX_BYTES,
    PACKET_BYTES,
    RTS,
    TP_CM,
    TP_DT,
)

PRIORITY = 7  # of both transport groups
SPACING = 0.05  # s between data packets
T3 = 1.25  # s without an answer, or without a turn, after which a message is given up; T4, of a CTS for 0, is shorter
TIMED_OUT = 3  # reason of an abort
MAX_CONNECTIONS = 4  # nodes that may be sent to at a time
NO_LIMIT = 0xFF  # packets that we accept in one CTS


@dataclass(kw_only=True)
class _Session:
    """Unfinished message to ``destination``; packets are counted from 1."""

    destination: int
    pgn: int
    payload: bytes
    following: int = 1  # packet to be sent next
    allowed: int = 0  # last packet that may be sent
    is_announced: bool = False
    t: float = 0.0  # [s] of the latest frame sent, or answer heard

    @property
    def packets(self) -> int:
        return -(-len(self.payload) // PACKET_BYTES)

    def control(self, first: bytes) -> bytes:
        """Frame of connection management, of its first five bytes and the PGN."""
        return first + self.pgn.to_bytes(3, "little")

    def announcement(self) -> bytes:
        kind = BAM if self.destination == GLOBAL else RTS
        limit = GLOBAL if self.destination == GLOBAL else NO_LIMIT
        return self.control(bytes([kind, *len(self.payload).to_bytes(2, "little"), self.packets, limit]))

    def packet(self) -> bytes:
        content = self.payload[PACKET_BYTES * (self.following - 1) : PACKET_BYTES * self.following]
        return bytes([self.following]) + content.ljust(PACKET_BYTES, b"\xff")


class TransportSender:
    """Cuts messages into frames; times are seconds that never decrease."""

    def __init__(self) -> None:
        self._sessions: dict[int, _Session] = {}  # by destination
        self._address: int | None = None

    @property
    def is_idle(self) -> bool:
        """True if no message is unfinished."""
        return not self._sessions

    def send(self, destination: int, pgn: int, payload: bytes) -> bool:
        """Send 9 to 1785 bytes to one node, or to all if ``destination`` is GLOBAL.

        Returns False, and sends nothing, while messages to this destination, or to too many others, are unfinished.

        Raises
        ------
        ValueError
            The payload has another size.
        """
        if not CLASSIC_BYTES < len(payload) <= MAX_BYTES:
            raise ValueError(f"{len(payload)} bytes: the transport protocol takes 9 to {MAX_BYTES}")
        others = sum(to != GLOBAL for to in self._sessions)
        if destination in self._sessions or (destination != GLOBAL and others >= MAX_CONNECTIONS):
            return False
        self._sessions[destination] = _Session(destination=destination, pgn=pgn, payload=payload)
        return True

    def hear(self, source: int, data: bytes, t: float) -> None:
        """Process a frame of connection management (8 bytes) from ``source`` to this node at time ``t`` [s]."""
        session = self._sessions.get(source)
        if session is None or not session.is_announced or len(data) != CLASSIC_BYTES:
            return
        if int.from_bytes(data[5:], "little") != session.pgn:
            return
        if data[0] in (END_OF_MESSAGE, ABORT):
            del self._sessions[source]
        elif data[0] == CTS:
            session.t = t
            count, following = data[1], data[2]
            if count and 1 <= following <= session.packets:
                session.following = following
                session.allowed = min(session.packets, following + count - 1)

    def poll(self, t: float, address: int) -> list[can.Message]:
        """Return the frames due at time ``t`` [s] from ``address``; messages begun from another address are dropped."""
        if self._address not in (None, address):
            self._sessions = {}
        self._address = address
        return [frame for session in list(self._sessions.values()) for frame in self._advance(session, t)]

    def _advance(self, session: _Session, t: float) -> list[can.Message]:
        if not session.is_announced:
            session.is_announced, session.t = True, t
            session.allowed = session.packets if session.destination == GLOBAL else 0
            return [self._frame(TP_CM, session, session.announcement())]
        if t - session.t > T3:
            del self._sessions[session.destination]
            abort = session.control(bytes([ABORT, TIMED_OUT, 0xFF, 0xFF, 0xFF]))
            return [] if session.destination == GLOBAL else [self._frame(TP_CM, session, abort)]
        if session.following > session.allowed or t - session.t < SPACING:
            return []
        packet = self._frame(TP_DT, session, session.packet())
        session.following, session.t = session.following + 1, t
        if session.destination == GLOBAL and session.following > session.packets:
            del self._sessions[GLOBAL]
        return [packet]

    def _frame(self, group: int, session: _Session, data: bytes) -> can.Message:
        ident = PRIORITY << 26 | group << 8 | session.destination << 8 | (self._address or 0)
        return can.Message(arbitration_id=ident, data=data, is_extended_id=True, is_rx=False)

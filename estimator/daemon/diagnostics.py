"""Our own faults on the bus: DM1 every second, DM1, DM2, DM3 and DM11 on request (SAE J1939-73)."""

import logging
from collections.abc import Callable, Collection

import can

from estimator.can_io.frames import CLASSIC_BYTES
from estimator.can_io.j1939 import GLOBAL, PACKET_BYTES
from estimator.can_io.j1939_node import POSITIVE, PRIORITY, Node, TokenBucket
from estimator.can_io.publisher import Schedule
from estimator.can_io.transport_sender import TransportSender
from estimator.can_io.trouble_codes import DM1, DM2, DM3, DM11, MAX_CODES, TroubleCode, TroubleMemory

log = logging.getLogger(__name__)

PERIOD = 1.0  # s between two DM1 (J1939-73)
MAX_FRAMES = 1 + -(-(2 + 4 * MAX_CODES) // PACKET_BYTES)  # of one message
ANSWER_RATE, ANSWER_BURST = 10.0, 2 * MAX_FRAMES  # frames per second, and at once, of answers in several packets

Allowed = Callable[[int], bool]


class Diagnostics:
    """DM1, DM2, DM3 and DM11 of one node; times are monotonic [s]."""

    def __init__(self) -> None:
        self.memory = TroubleMemory()
        self.transport = TransportSender()
        self._schedule = Schedule(PERIOD)
        self._answers = TokenBucket(ANSWER_RATE, ANSWER_BURST)
        self._now = 0.0
        self._was_cleared = False  # since the last look at the faults

    def observe(self, present: Collection[TroubleCode], now: float) -> bool:
        """Take the faults that there are now; a change is broadcast at once.

        Whether the active codes changed, or codes were cleared since the last call.
        """
        changed = self.memory.observe(present, now)
        if changed:
            self._schedule.restart(now)
        changed, self._was_cleared = changed or self._was_cleared, False
        return changed

    def poll(self, now: float, address: int, may_send: Allowed) -> list[can.Message]:
        """Frames that are due, from ``address``; ``may_send`` is asked for all frames of a DM1 before it begins."""
        self._now = now
        frames = []
        if self._schedule.due(now) is not None:
            content = self.memory.message(DM1)
            if may_send(frame_count(content)):
                frames = self._frames(DM1, content, GLOBAL, address) or []
        return frames + self.transport.poll(now, address)

    def answer(self, pgn: int, requester: int, node: Node) -> list[can.Message] | None:
        """Frames that answer a request at once, more may follow by `poll`; None for a group that is not ours."""
        if pgn in (DM3, DM11):
            self._clear(pgn)
            return [] if requester == GLOBAL else [node.acknowledge(pgn, requester, POSITIVE)]
        if pgn not in (DM1, DM2) or node.address is None:
            return None
        content = self.memory.message(pgn)
        count = frame_count(content)
        frames = None
        if count == 1 or self._answers.take(self._now, count):
            frames = self._frames(pgn, content, requester, node.address)
        if frames is None:
            node.counts["request not answered"] += 1
        return frames or []

    def _clear(self, pgn: int) -> None:
        """Forget the active codes (DM11), or the previously active ones (DM3)."""
        if pgn == DM11 and self.memory.clear_active():
            self._schedule.restart(self._now)
        elif pgn == DM11 or not self.memory.clear_previous():
            return
        self._was_cleared = True
        kind = "active" if pgn == DM11 else "previously active"
        log.info("%s trouble codes cleared, as another node asked", kind)

    def _frames(self, pgn: int, content: bytes, destination: int, address: int) -> list[can.Message] | None:
        """The frame of a short message; of a long one, none yet; None where it has to wait for another."""
        if len(content) > CLASSIC_BYTES:
            return [] if self.transport.send(destination, pgn, content) else None
        ident = PRIORITY << 26 | pgn << 8 | address
        return [can.Message(arbitration_id=ident, data=content, is_extended_id=True, is_rx=False)]


def frame_count(content: bytes) -> int:
    """Frames of a message, with the announcement of the transport protocol where it is needed."""
    return 1 if len(content) <= CLASSIC_BYTES else 1 + -(-len(content) // PACKET_BYTES)

"""The only module that sends: as a node with an address, no group that others send, at a bounded rate.

Frames that are withheld are counted by reason. They are not sent later, because their values would be old.
"""

import logging
from collections import Counter
from collections.abc import Callable
from enum import StrEnum

import can
import numpy as np
from numpy.typing import NDArray

from estimator.can_io.foreign_senders import CVW, ForeignSenders
from estimator.can_io.frames import EXTENDED, Frames
from estimator.can_io.j1939 import GLOBAL, TP_CM, Transport, pgn_of
from estimator.can_io.j1939_name import BYTES, Name
from estimator.can_io.j1939_node import ADDRESS_CLAIMED, COMMANDED_ADDRESS, REQUEST, Node, TokenBucket
from estimator.can_io.publisher import Publisher, output_groups
from estimator.can_io.trouble_codes import DM1
from estimator.daemon.diagnostics import Diagnostics
from estimator.estimates import Estimate, Slope
from estimator.settings import Publish, Transmit

log = logging.getLogger(__name__)

BURST_DURATION = 3.0  # seconds' worth of frames that may go out at once
CLAIM_RETRY = 1.0  # s after a claim that could not be sent
MIN_RETRY, MAX_RETRY = 10.0, 300.0  # s without an address, before it is claimed anew
RETRY_RESET = 600.0  # s with an address, after which the pause is the shortest again


class Withheld(StrEnum):
    """Why a frame was not sent."""

    FOREIGN_CVW = "another node sends the CVW"
    COLLISION = "another node sends from our address"
    TOO_MANY = "too many frames"


class Transmitter:
    """Broadcasts the estimate on one bus.

    Parameters
    ----------
    publish, transmit
        What is sent, and as whom.
    send
        Puts a message on the bus; raises OSError or `can.CanError`.
    rng
        Source of the random delays of address claim.
    """

    def __init__(
        self, publish: Publish, transmit: Transmit, send: Callable[[can.Message], None], rng: np.random.Generator
    ) -> None:
        self.published = 0
        self.withheld: Counter[Withheld] = Counter()  # frames, by reason
        self.failed = 0
        self._send, self._rng = send, rng
        self._preferred = publish.source_address
        self._name = _name_of(transmit)
        self._publisher = Publisher(publish)
        self.diagnostics = Diagnostics() if transmit.diagnostics else None
        self._is_commandable = transmit.commanded_address
        self._incoming = Transport()
        self._neighbours = ForeignSenders(output_groups() | {DM1})
        self._bucket = TokenBucket(
            transmit.frames_per_second, max(1, round(BURST_DURATION * transmit.frames_per_second))
        )
        self.estimate: Estimate | None = None
        self.slope: Slope | None = None
        self._t = 0.0  # message time [s] of the latest turn
        self._foreign: list[int] = []
        self._quiet_until = -np.inf
        self._past: Counter[str] = Counter()  # events of earlier nodes
        self._pause = MIN_RETRY
        self._lost_at: float | None = None  # [s]
        self._gained_at: float | None = None  # [s]
        self.node = self._new_node()

    @property
    def address(self) -> int | None:
        """Address we may send from, None while there is none."""
        return self.node.address

    @property
    def foreign_weights(self) -> list[int]:
        """Source addresses from which others send the combination vehicle weight."""
        return self._foreign

    @property
    def colliding_groups(self) -> list[int]:
        """PGNs that others send from our address."""
        own = -1 if self.address is None else self.address
        return [pgn for pgn in sorted(output_groups(cvw=False)) if self._neighbours.is_occupied(pgn, own, self._t)]

    @property
    def events(self) -> Counter[str]:
        """Number of events of our address, by name."""
        return self._past + self.node.counts

    def restart(self) -> None:
        """Claim an address anew, as after the bus has been away."""
        self._past += self.node.counts
        self.node = self._new_node()

    def _new_node(self) -> Node:
        self._lost_at = self._gained_at = None
        return Node(self._name, self._preferred, self._rng, self._answer, self._is_commandable)

    def hear(self, frames: Frames, own: Frames, now: float) -> None:
        """Take what others sent, and our ``own`` frames that have been on the bus by monotonic time ``now`` [s].

        Requests and claims of others are answered.
        """
        self._neighbours.watch(frames)
        if now < self._quiet_until:
            return
        for message in own[pgn_of(own.ident) == ADDRESS_CLAIMED].messages():
            message.is_rx = False
            self._put(self.node.hear(message, now), now)
        pgn = pgn_of(frames.ident)
        from_ours = frames.ident & 0xFF == (-1 if self.address is None else self.address)
        concerned = (frames.ident & EXTENDED != 0) & ((pgn == ADDRESS_CLAIMED) | (pgn == REQUEST) | from_ours)
        for message in frames[concerned].messages():
            self._put(self.node.hear(message, now), now)
        self._hear_transport(frames, pgn, now)

    def hear_elsewhere(self, frames: Frames) -> None:
        """Take what others sent on a bus that we do not send on: of it, only the weight of the vehicle matters."""
        self._neighbours.watch(frames[pgn_of(frames.ident) == CVW])

    def _hear_transport(self, frames: Frames, pgn: NDArray[np.uint32], now: float) -> None:
        """Take the answers of those we send several packets to, and Commanded Address."""
        if self.diagnostics is not None and self.address is not None:
            ours = (frames.ident & EXTENDED != 0) & (pgn == TP_CM) & (frames.ident >> 8 & 0xFF == self.address)
            for message in frames[ours].messages():
                self.diagnostics.transport.hear(message.arbitration_id & 0xFF, bytes(message.data), now)
        for whole in self._incoming.feed(frames):
            if whole.destination == GLOBAL and whole.pgn == COMMANDED_ADDRESS and len(whole.payload) == BYTES + 1:
                name, address = int.from_bytes(whole.payload[:BYTES], "little"), whole.payload[BYTES]
                if self.node.take_command(name, address, now):
                    log.info("address %d, as another node commanded", address)
                    self._preferred = address
                self._put(self.node.poll(now), now)

    def turn(
        self, now: float, t: float, estimate: Estimate | None, is_receiving: bool, slope: Slope | None = None
    ) -> None:
        """Send what is due at monotonic time ``now`` and message time ``t`` [s]; ``slope`` at that time.

        Unless ``is_receiving``, nothing is sent: a sending node would wake the bus, and the values would be old.
        """
        self.estimate, self.slope, self._t = estimate, slope, t
        self._foreign = self._neighbours.senders(CVW, t)
        if now < self._quiet_until or not is_receiving:
            return
        self._put(self.node.poll(now), now)
        self._retry(now)
        address = self.node.address
        if address is None:
            return
        self._publisher.source_address = address
        for message in self._publisher.poll(t, estimate, slope):
            self._broadcast(message, now)
        if self.diagnostics is not None:
            for message in self.diagnostics.poll(now, address, lambda count: self._may_send(DM1, address, count, now)):
                self._send_counted(message)

    def _retry(self, now: float) -> None:
        """Claim an address again after a pause, which doubles each time the address is lost."""
        if not self.node.lost:
            if self.address is not None:
                self._gained_at = now if self._gained_at is None else self._gained_at
                if now - self._gained_at > RETRY_RESET:
                    self._pause = MIN_RETRY
            return
        if self._lost_at is None:
            self._lost_at = now
            why = self.node.fault or "others have all addresses that we may take"
            log.warning("no address: %s; claimed anew in %g s", why, self._pause)
        elif now - self._lost_at >= self._pause:
            self._pause = min(2 * self._pause, MAX_RETRY)
            self.restart()

    def send_not_available(self, now: float, t: float) -> None:
        """Send all values as "not available", at the end of the transmission."""
        if self.node.address is not None:
            for message in self._publisher.poll(t, None):
                self._broadcast(message, now)

    def _answer(self, pgn: int, requester: int) -> list[can.Message] | None:
        if self.diagnostics is not None and (answer := self.diagnostics.answer(pgn, requester, self.node)) is not None:
            return answer
        if self.node.address is not None:
            self._publisher.source_address = self.node.address
        message = self._publisher.answer(pgn, self._t, self.estimate, self.slope)
        if message is None or self._reason_to_withhold(pgn, message.arbitration_id & 0xFF) is not None:
            return None
        return [message]

    def _broadcast(self, message: can.Message, now: float) -> None:
        group, source = message.arbitration_id >> 8 & 0x3FFFF, message.arbitration_id & 0xFF
        if self._may_send(group, source, 1, now):
            self._send_counted(message)

    def _may_send(self, group: int, source: int, count: int, now: float) -> bool:
        """Whether ``count`` frames with a group may be broadcast now; those that may not are counted."""
        reason = self._reason_to_withhold(group, source)
        if reason is None and not self._bucket.take(now, count):
            reason = Withheld.TOO_MANY
        if reason is not None:
            self.withheld[reason] += count
            log.warning("frames withheld: %s", reason.value)
        return reason is None

    def _send_counted(self, message: can.Message) -> None:
        try:
            self._send(message)
        except (OSError, can.CanError) as error:
            self.failed += 1
            log.warning("sending failed: %s", error)
        else:
            self.published += 1

    def _reason_to_withhold(self, group: int, source: int) -> Withheld | None:
        if not self._neighbours.is_occupied(group, source, self._t):
            return None
        return Withheld.FOREIGN_CVW if group == CVW else Withheld.COLLISION

    def _put(self, messages: list[can.Message], now: float) -> None:
        """Send the messages of the node; a claim that could not be sent is repeated after CLAIM_RETRY."""
        for message in messages:
            try:
                self._send(message)
            except (OSError, can.CanError) as error:
                self.failed += 1
                log.warning("sending failed: %s", error)
                if message.arbitration_id >> 8 & 0x3FF00 == ADDRESS_CLAIMED:
                    self._quiet_until = now + CLAIM_RETRY
                    self.restart()
                    return


def _name_of(transmit: Transmit) -> Name:
    return Name(
        identity=transmit.identity,
        manufacturer=transmit.manufacturer,
        ecu_instance=transmit.ecu_instance,
        function_instance=transmit.function_instance,
        function=transmit.function,
        vehicle_system=transmit.vehicle_system,
        vehicle_system_instance=transmit.vehicle_system_instance,
        industry_group=transmit.industry_group,
        arbitrary_address_capable=int(transmit.arbitrary_address),
    )

"""J1939 node without a bus: messages and times in, answers out (SAE J1939-81, J1939-21).

The node claims and defends an address, yields it to a lower NAME, and answers or refuses requests. The package
can-j1939 is not used. Its thread runs on time.time(), so a clock set back stalls its claim; it sends no negative
acknowledgement, and does not limit floods.
"""

from collections import Counter
from collections.abc import Callable

import can
import numpy as np

from estimator.can_io.j1939_name import BYTES, Name
from estimator.errors import ConfigError

ADDRESS_CLAIMED = 0xEE00  # 60928
REQUEST = 0xEA00  # 59904
ACKNOWLEDGEMENT = 0xE800  # 59392
COMMANDED_ADDRESS = 0xFED8  # 65240: a NAME and the address that it is to take, 9 bytes by BAM
POSITIVE, NEGATIVE = 0, 1  # control byte of an acknowledgement
NULL, GLOBAL = 0xFE, 0xFF  # addresses: of a node without one, and of everybody
FREE = range(128, 248)  # addresses that a node may give itself
STANDS_AFTER = 0.25  # s on the bus without a better claim (J1939-81)
CONFIRMED_WITHIN = 1.0  # s, after which a claim that has not been on the bus is sent again
MAX_CLAIM_DELAY = 0.153  # s before "cannot claim": the random delay separates nodes that lost at once (J1939-81)
PRIORITY = 6
CLAIM_RATE, CLAIM_BURST = 4.0, 4  # claims per second, and at once
ANSWER_RATE, ANSWER_BURST = 10.0, 10  # of all other answers

Answer = Callable[[int, int], list[can.Message] | None]


class TokenBucket:
    """Rate limit: ``burst`` actions at once, and ``rate`` per second in the long term."""

    def __init__(self, rate: float, burst: int) -> None:
        self._rate, self._burst = rate, float(burst)
        self._tokens = self._burst
        self._t: float | None = None

    def take(self, t: float, count: int = 1) -> bool:
        """Take ``count`` tokens at time ``t`` [s], which never decreases; False if there are too few."""
        elapsed = 0.0 if self._t is None else t - self._t
        self._t = t
        self._tokens = min(self._burst, self._tokens + self._rate * elapsed)
        if self._tokens < count:
            return False
        self._tokens -= count
        return True


class Node:
    """Node with one address on a J1939 network.

    Parameters
    ----------
    name
        NAME of this node; no other node may have it.
    address
        Preferred address, 0..253.
    rng
        Source of the random delay.
    answer
        Returns the frames that answer a request for a parameter group by the node at an address, or by all nodes if
        that is GLOBAL; None if this node does not have the group. Called only while the node has an address.
    is_commandable
        True if another node may command another address.

    Times are seconds that never decrease; a smaller one counts as the largest so far. Messages that `poll` and `hear`
    return must be sent. Once on the bus, they must be passed to `hear` with ``is_rx`` False: a driver may delay a claim
    while the bus is busy. A node that has ``lost`` its address does not claim again; build another node, as after the
    bus was reopened.

    Raises
    ------
    ConfigError
        The address is out of its range.
    """

    def __init__(
        self,
        name: Name,
        address: int,
        rng: np.random.Generator,
        answer: Answer = lambda pgn, requester: None,
        is_commandable: bool = False,
    ) -> None:
        if not 0 <= address < NULL:
            raise ConfigError(f"J1939 address {address}: give 0..253")
        self.lost = False  # no address to be had; nothing may be sent any more
        self.fault = ""  # why it was lost, when another node has our NAME
        self.counts: Counter[str] = Counter()  # what happened, by name
        self._name = name
        self._rng = rng
        self._answer, self._is_commandable = answer, is_commandable
        self._wanted = address
        self._others: dict[int, int] = {}  # NAMEs by the address they claim
        self._now = -np.inf
        self._claimed: float | None = None  # when the claim of _wanted was last handed out to be sent
        self._since: float | None = None  # when it was first on the bus
        self._asked = False  # who else is there
        self._owed: float | None = -np.inf  # time from which a claim, or "cannot claim", is to be sent
        self._claims = TokenBucket(CLAIM_RATE, CLAIM_BURST)
        self._answers = TokenBucket(ANSWER_RATE, ANSWER_BURST)

    @property
    def address(self) -> int | None:
        """Address of this node, from 250 ms after its uncontested claim; None before, and once it is lost."""
        stands = not self.lost and self._since is not None and self._now - self._since >= STANDS_AFTER
        return self._wanted if stands else None

    def take_command(self, name: int, address: int, t: float) -> bool:
        """Process a Commanded Address (J1939-81) at time ``t`` [s]; returns True if its address is claimed.

        A command for this NAME is always answered by a claim. The claim is of the present address if the node is not
        commandable, or another node has claimed the new one.
        """
        self._now = max(self._now, t)
        if name != int(self._name) or self.fault:
            return False
        taken = self._is_commandable and address < NULL and address not in self._others
        self.counts["commanded address taken" if taken else "commanded address refused"] += 1
        if taken and (address != self._wanted or self.lost):
            self._wanted, self.lost = address, False
            self._claimed = self._since = self._owed = None
        self._schedule_claim(self._now)
        return taken

    def poll(self, t: float) -> list[can.Message]:
        """Messages that are due at time ``t`` [s]; call it at least every 100 ms."""
        self._now = max(self._now, t)
        if self._owed is None and self._is_unconfirmed():
            self.counts["claim not confirmed"] += 1
            self._schedule_claim(self._now)
        if self.fault or self._owed is None or self._now < self._owed:
            return []
        if not self._claims.take(self._now):
            self.counts["claim put off"] += 1
            return []
        self._owed = None
        if self.lost:
            return [self._claim(NULL)]
        self._claimed = self._now
        claim = [self._claim(self._wanted)]
        if not self._asked:
            self._asked = True
            return [_message(REQUEST, GLOBAL, NULL, ADDRESS_CLAIMED.to_bytes(3, "little")), *claim]
        return claim

    def hear(self, message: can.Message, t: float) -> list[can.Message]:
        """Process a message of the bus at time ``t`` [s]; returns the messages to be sent now.

        A message with ``is_rx`` False is one of this node that has been on the bus. On SocketCAN, python-can also marks
        messages of other programs of this host in this way: pass those with ``is_rx`` True.
        """
        self._now = max(self._now, t)
        answers: list[can.Message] = []
        if message.is_extended_id and not (message.is_error_frame or message.is_remote_frame or self.fault):
            if message.is_rx:
                answers = self._take(message)
            else:
                self._confirm(message, t)
        return answers + self.poll(t)

    def _is_unconfirmed(self) -> bool:
        waited = 0.0 if self._claimed is None or self._since is not None else self._now - self._claimed
        return not self.lost and waited > CONFIRMED_WITHIN

    def _confirm(self, message: can.Message, t: float) -> None:
        """Note that the claim has been on the bus; a claim from before it was returned is from another node."""
        ours = self._claim(self._wanted)
        same = message.arbitration_id == ours.arbitration_id and message.data == ours.data
        if same and not self.lost and self._since is None and self._claimed is not None and t >= self._claimed:
            self._since = self._now

    def _take(self, message: can.Message) -> list[can.Message]:
        ident, data = message.arbitration_id, bytes(message.data)
        group, destination, source = ident >> 8 & 0x3FF00, ident >> 8 & 0xFF, ident & 0xFF
        if group == ADDRESS_CLAIMED and len(data) == BYTES:
            self._hear_claim(source, int.from_bytes(data, "little"))
        elif source == self._reachable_at():
            self.counts["our address used by another"] += 1
        elif group == REQUEST and len(data) >= 3 and destination in (GLOBAL, self._reachable_at()):
            return self._hear_request(int.from_bytes(data[:3], "little"), source, destination == GLOBAL)
        return []

    def _reachable_at(self) -> int | None:
        """Claimed address, including that of a claim younger than 250 ms."""
        return None if self.lost or self._claimed is None else self._wanted

    def _hear_claim(self, source: int, name: int) -> None:
        ours = int(self._name)
        if name == ours and source in (self._wanted, NULL):
            # A copy of our own claim contradicts nothing; a twin is known by what it sends from our address.
            self.counts["own claim repeated"] += 1
            return
        if name == ours:
            self.lost, self.fault = True, f"another node, at address {source}, has our NAME {ours:016X}"
            self.counts["NAME used by another"] += 1
            return
        self._others = {address: other for address, other in self._others.items() if other != name}
        if source >= NULL:
            return
        if source != self._wanted or self.lost:
            self._others[source] = name
        elif ours < name:
            self.counts["address defended"] += 1
            self._schedule_claim(self._now)
        else:
            self._others[source] = name
            self._give_way()

    def _give_way(self) -> None:
        """Yield the address to a lower NAME: claim the next free one, or send "cannot claim" if there is none."""
        self.counts["address lost"] += 1
        self._claimed = self._since = self._owed = None
        following = [*range(self._wanted + 1, FREE.stop), *FREE] if self._wanted in FREE else FREE
        free = (address for address in following if address not in self._others)
        next_free = next(free, None) if self._name.arbitrary_address_capable else None
        if next_free is None:
            self.lost = True
            self._schedule_claim(self._now + self._rng.uniform(0, MAX_CLAIM_DELAY))
        else:
            self._wanted = next_free
            self._schedule_claim(self._now)

    def _schedule_claim(self, t: float) -> None:
        """Schedule a claim; it answers all requests for one until it is sent."""
        self._owed = t if self._owed is None else self._owed

    def _hear_request(self, pgn: int, source: int, everybody: bool) -> list[can.Message]:
        if pgn == ADDRESS_CLAIMED:
            self._schedule_claim(self._now + (self._rng.uniform(0, MAX_CLAIM_DELAY) if self.lost else 0.0))
            return []
        if self.address is None or source >= NULL:
            return []
        if not self._answers.take(self._now):
            self.counts["request not answered"] += 1
            return []
        answer = self._answer(pgn, GLOBAL if everybody else source)
        if answer is not None:
            return answer
        if everybody:
            return []
        self.counts["request refused"] += 1
        return [self.acknowledge(pgn, source, NEGATIVE)]

    def acknowledge(self, pgn: int, requester: int, control: int) -> can.Message:
        """Positive or negative acknowledgement of a request for a group."""
        data = bytes([control, 0xFF, 0xFF, 0xFF, requester]) + pgn.to_bytes(3, "little")
        return _message(ACKNOWLEDGEMENT, GLOBAL, self._wanted, data)

    def _claim(self, source: int) -> can.Message:
        return _message(ADDRESS_CLAIMED, GLOBAL, source, bytes(self._name))


def _message(group: int, destination: int, source: int, data: bytes) -> can.Message:
    ident = PRIORITY << 26 | group << 8 | destination << 8 | source
    return can.Message(arbitration_id=ident, data=data, is_extended_id=True, is_rx=False)

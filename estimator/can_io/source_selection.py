"""The address from which each signal is taken, and the times in which none is used.

Traffic is judged in blocks of some seconds. The choice rests on the readings and can be revised:

* The first address is the one with the most valid readings in a block; one that falls silent for ``release_s`` while
  another sends is given up for it.
* Readings that contradict each other (see `contradiction`) make a signal *contested*: no reading of it is used, until
  there has been no contradiction for ``contest_s``.
* After a contest the address that was used before stays, if it still sends. Where another one replaces it, all that was
  learnt from the first may be wrong: `Verdict.replaced`.

Times are those of messages, so live and replayed traffic are judged alike.
"""

from collections import deque
from dataclasses import dataclass
from enum import Enum, auto
from typing import Annotated, Any, Protocol

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from estimator.can_io.binding import BoundMessage, BoundSignal
from estimator.can_io.contradiction import MAGNITUDE, Contradiction, is_alternating, is_disagreement, is_flickering
from estimator.checkpoint.validation import State, read, substate
from estimator.errors import StateError
from estimator.settings import Bus
from estimator.signals import DIMENSION, STATE, Floats, Mask, Role

Address = Annotated[int, Meta(ge=0, le=255)]

NO_ADDRESS = 0  # of messages that are matched by their whole id
MAX_RATE_RATIO = 1.5  # times its own rate, at which more than one node sends under an address
OWN_RATE_BLOCKS = 12  # newest blocks without a contest, 1 min, whose median is a sender's own rate
MIN_RATE_BLOCKS = 3  # of them, before that rate counts as known
MIN_READINGS_FOR_RATE = 6  # readings in a block for a rate
NEW_RATE_S = 600.0  # s after which a rate that contradicts nothing else counts as the sender's own
MIN_PERIOD_S = 0.01  # shortest period of a J1939 parameter group
SLOW_GROUP_HZ = 60.0  # that a group may always reach: EEC3, meant for 4 Hz, is sent with 50 by some
MAX_NOMINAL_RATES = 4.0  # times the rate of the database that a group may reach, up to the shortest period
JITTER = 1.2  # times the rate of the shortest period
MAX_CONTEST_GROWTH = 20  # times the shortest, to which contests grow that follow each other
RECURRENCE = 10  # times its duration, within which a contest after another counts as the same again
MIN_RIVAL_READINGS = 3  # readings in a block, below which a sender is no evidence against one with more


class Kind(Enum):
    """How the estimate uses a signal."""

    MEASURED = auto()  # a term of the road load
    CONSTANT = auto()  # a property of the engine
    GATE = auto()  # excludes moments; several nodes may rightly send different values
    AUXILIARY = auto()  # refines


_KINDS = {
    Kind.MEASURED: (
        *(Role.SPEED, Role.WHEEL_SPEEDS, Role.ENGINE_POWER, Role.ENGINE_TORQUE, Role.ENGINE_SPEED),
        *(Role.TORQUE_FRACTION, Role.FRICTION_FRACTION, Role.PARASITIC_FRACTION),
    ),
    Kind.CONSTANT: (Role.REFERENCE_TORQUE,),
    Kind.GATE: (
        *(Role.GEAR, Role.BRAKE_SWITCH, Role.BRAKE_PEDAL, Role.CLUTCH_SWITCH, Role.SHIFT_IN_PROCESS),
        *(Role.DRIVELINE_ENGAGED, Role.RETARDER_FRACTION, Role.PARK_BRAKE),
    ),
}
KIND: dict[Role, Kind] = {role: kind for kind, roles in _KINDS.items() for role in roles}


@dataclass(frozen=True, slots=True)
class Heard:
    """What all addresses sent of one signal in a block that ends at ``end`` [s].

    ``t`` [s], ``source`` (address) and ``value`` [SI], NaN where not valid: all (n,), in order of arrival.
    """

    t: Floats
    source: NDArray[np.uint8]
    value: Floats
    end: float

    def of(self, chosen: Mask) -> "Heard":
        """The readings that ``chosen`` (n,) selects."""
        return Heard(self.t[chosen], self.source[chosen], self.value[chosen], self.end)

    @property
    def valid(self) -> "Heard":
        """The readings that hold a value."""
        finite = np.isfinite(self.value)
        return self if finite.all() else self.of(finite)

    def by_source(self) -> "dict[int, Heard]":
        """The readings of each address, the most frequent first, then the lowest."""
        if len(self.t) and (self.source == self.source[0]).all():
            return {int(self.source[0]): self}
        counts = np.bincount(self.source)
        addresses = sorted(np.flatnonzero(counts).tolist(), key=lambda address: -counts[address])
        return {address: self.of(self.source == address) for address in addresses}


@dataclass(frozen=True, slots=True)
class Verdict:
    """Which readings of a block are the signal's: ``taken`` (n,).

    ``contested`` is the reason why they are not used, empty if they are. ``replaced``: they come from another sender
    than the readings before, which was wrong or was never compared with this one.
    """

    taken: Mask
    contested: str = ""
    replaced: bool = False


class Choice(Protocol):
    """The sender of one signal, chosen block by block."""

    source: int | None

    def judge(self, heard: Heard) -> Verdict:
        """Judge the next block."""

    def release(self) -> None:
        """Choose anew: another vehicle, or much time, may lie between the blocks."""

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads."""

    def restore(self, state: State) -> None:
        """Go on where another choice was."""


def fastest(cycle: float | None) -> float:
    """Rate [1/s] that a J1939 group with this cycle time [s] in the database may reach at one address."""
    most = JITTER / MIN_PERIOD_S
    return most if not cycle else min(most, max(SLOW_GROUP_HZ, MAX_NOMINAL_RATES / cycle))


class Contest:
    """A contradiction and the time until it counts as over; ``reason`` is empty while there is none.

    It lasts for ``shortest`` [s] after the last contradiction; one that comes again soon lasts twice as long, because
    a wrong reading contradicts the others only while the vehicle works.
    """

    def __init__(self, shortest: float) -> None:
        self.reason = ""
        self.before: float | None = None  # address or value in use when it began
        self._shortest = self._duration = shortest
        self._until = -np.inf  # [s]

    def extend(self, reason: str, end: float, believed: float | None) -> None:
        """Take a contradiction in the block that ended at ``end`` [s]."""
        if not self.reason:
            self.before = believed
            recurs = end - self._until < RECURRENCE * self._duration
            longer = min(2 * self._duration, MAX_CONTEST_GROWTH * self._shortest)
            self._duration = longer if recurs else self._shortest
        self.reason, self._until = reason, end + self._duration

    def is_over(self, end: float) -> bool:
        """Whether nothing has contradicted for long enough at time ``end`` [s]; false while there is no contest."""
        return bool(self.reason) and end >= self._until

    def settle(self) -> None:
        """End it."""
        self.reason, self.before = "", None

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads."""
        until = self._until if np.isfinite(self._until) else None
        return {"reason": self.reason, "before": self.before, "until": until, "duration": self._duration}

    def restore(self, state: State) -> None:
        """Go on with another contest.

        Raises
        ------
        StateError
            The state is not that of a contest.
        """
        self.reason, self.before = read(state, "reason", str), read(state, "before", float | None)
        if self.reason not in ("", *Contradiction):
            raise StateError(f"reason: {self.reason!r} is none")
        until = read(state, "until", float | None)
        self._until = -np.inf if until is None else until
        longest = MAX_CONTEST_GROWTH * self._shortest
        self._duration = min(max(read(state, "duration", float), self._shortest), longest)


class SenderChoice:
    """The address from which a signal that varies is taken; see `choice`."""

    def __init__(self, role: Role, step: float, configured: int | None, highest_rate: float, settings: Bus) -> None:
        self.source = configured
        self._kind, self._is_state = KIND.get(role, Kind.AUXILIARY), DIMENSION[role] == STATE
        self._magnitude, self._step, self._configured = MAGNITUDE.get(role, 0.0), step, configured
        self._release, self._patience = settings.release_s, settings.contest_s
        self._rate = OwnRate(highest_rate, follows_value=role is Role.ENGINE_SPEED)
        self._is_j1939 = bool(np.isfinite(highest_rate))  # how values alternate is known of its groups alone
        self._is_rated = self._kind is Kind.MEASURED and role is not Role.TORQUE_FRACTION  # comes with the engine speed
        self._contest = Contest(settings.contest_s)
        self._last: dict[int, float] = {}  # time of the newest valid reading [s], by address
        self._agreed: set[int] = set()  # addresses that sent what the chosen one sent

    def judge(self, heard: Heard) -> Verdict:
        """Judge the next block."""
        senders = heard.valid.by_source() if len(heard.t) else {}
        if self._configured is not None:
            senders = {address: part for address, part in senders.items() if address == self._configured}
        self._last |= {address: float(part.t[-1]) for address, part in senders.items()}
        if senders and (reason := self._contradiction(senders, heard.end)):
            self._contest.extend(reason, heard.end, self.source)
        replaced = self._contest.is_over(heard.end) and self._settle(senders, heard.end)
        if senders and not self._contest.reason:
            replaced |= self._follow(senders, heard.end)
        elif senders and self.source is None:
            self.source = next(iter(senders))
        taken = heard.source == (-1 if self.source is None else self.source)
        return Verdict(taken, self._contest.reason, replaced)

    def release(self) -> None:
        """Choose anew: another vehicle, or much time, may lie between the blocks."""
        self.source = self._configured
        self._last, self._agreed = {}, set()
        self._rate.forget()
        self._contest = Contest(self._patience)

    def state(self) -> dict[str, Any]:
        """The sender and the contest; not what traffic shows again in seconds."""
        return {"source": self.source, "contest": self._contest.state()}

    def restore(self, state: State) -> None:
        """Go on where another choice was.

        Raises
        ------
        StateError
            The state is not that of such a choice.
        """
        source = read(state, "source", Address | None)
        self.source = source if self._configured is None else self._configured
        self._contest.restore(substate(state, "contest"))

    def _contradiction(self, senders: dict[int, Heard], end: float) -> str:
        """Reason why the readings of a block are not used; empty where they are."""
        if self._kind is Kind.AUXILIARY:
            return ""
        chosen = self.source if self.source in senders else next(iter(senders))
        own = senders[chosen]
        if self._kind is Kind.MEASURED and not self._agree(own, senders, chosen):
            return Contradiction.SENDERS_DISAGREE
        repeats = is_flickering(own.value) if self._is_state else is_alternating(own.value, self._magnitude, self._step)
        if repeats and self._is_j1939:
            self._rate.doubt(end)
            return Contradiction.ALTERNATING
        if self._is_rated and self._rate.is_exceeded(own, self._step):
            return Contradiction.FASTER
        return ""

    def _agree(self, own: Heard, senders: dict[int, Heard], chosen: int) -> bool:
        """Whether no other address contradicts the chosen one; stores those that agree with it."""
        for address, other in senders.items():
            if address == chosen or len(other.t) < MIN_RIVAL_READINGS <= len(own.t):
                continue
            differ = is_disagreement(own.t, own.value, other.t, other.value, self._magnitude, self._step)
            if differ:
                return False
            if differ is not None:
                self._agreed.add(address)
        return True

    def _settle(self, senders: dict[int, Heard], end: float) -> bool:
        """End the contest if an address sends; whether it is another one than before."""
        recent = [address for address, t in self._last.items() if t >= end - self._patience]
        before = self._contest.before
        if not recent and self._kind is Kind.MEASURED:
            return False
        self._contest.settle()
        if before in recent or not recent:
            self.source = self.source if before is None else int(before)
            return False
        self.source = next((address for address in senders), max(recent, key=lambda address: self._last[address]))
        return before is not None

    def _follow(self, senders: dict[int, Heard], end: float) -> bool:
        """Choose the first sender, or give up one that is silent; whether it is replaced."""
        if self.source in senders:
            return False
        before, silent_since = self.source, self._last.setdefault(-1 if self.source is None else self.source, end)
        if before is not None and end - silent_since < self._release:
            return False
        self.source = next(iter(senders))
        self._rate.forget()
        return before is not None and self._kind is Kind.MEASURED and self.source not in self._agreed


class OwnRate:
    """The rate of a sender, learnt from blocks without a contradiction.

    ``highest`` [1/s] is that of any sender of the group. ``follows_value``: the rate may grow with the value, as that
    of EEC1 with the engine speed (J1939-71).
    """

    def __init__(self, highest: float, follows_value: bool) -> None:
        self._highest, self._follows_value = highest, follows_value
        self.forget()

    def forget(self) -> None:
        """Learn anew."""
        self._known: deque[tuple[float, float]] = deque(maxlen=OWN_RATE_BLOCKS)  # [1/s], and over the value
        self._since: float | None = None  # when the rate began to be exceeded [s]

    def doubt(self, end: float) -> None:
        """Take a contradiction of values in the block that ended at ``end`` [s]: a rate exceeded is not the own."""
        self._since = None if self._since is None else end

    def is_exceeded(self, own: Heard, step: float) -> bool:
        """Whether the valid readings of a block come too fast; a change of rate is not judged at rest."""
        n, size = len(own.t), float(np.abs(own.value).mean())
        span = float(own.t[-1] - own.t[0])
        if n < MIN_READINGS_FOR_RATE or span <= 0:
            return False
        rate = (n - 1) / span
        if rate > self._highest:
            return True
        return size > step and self._is_new((rate, rate / size), own.end)

    def _is_new(self, now: tuple[float, float], end: float) -> bool:
        usual = np.median(self._known, axis=0) if len(self._known) >= MIN_RATE_BLOCKS else np.full(2, np.inf)
        if now[0] <= MAX_RATE_RATIO * usual[0] or (self._follows_value and now[1] <= MAX_RATE_RATIO * usual[1]):
            self._since = None
            self._known.append(now)
            return False
        self._since = end if self._since is None else self._since
        if end - self._since >= NEW_RATE_S:
            self.forget()
        return bool(self._known)


class ConstantChoice:
    """The value of a constant and its sender: any other value, from whatever address, contests it."""

    def __init__(self, step: float, configured: int | None, settings: Bus) -> None:
        self.source = configured
        self._value: float | None = None  # in use
        self._step, self._configured, self._patience = step, configured, settings.contest_s
        self._contest = Contest(settings.contest_s)
        self._heard: dict[float, tuple[float, int]] = {}  # time [s] and address of the newest reading, by value

    def judge(self, heard: Heard) -> Verdict:
        """Judge the next block."""
        valid = np.isfinite(heard.value)
        if self._configured is not None:
            valid &= heard.source == self._configured
        for t, address, value in zip(heard.t[valid], heard.source[valid], heard.value[valid], strict=True):
            self._heard[float(value)] = (float(t), int(address))
        self._heard = {value: at for value, at in self._heard.items() if at[0] >= heard.end - self._patience}
        values = np.unique(heard.value[valid])
        if self._value is None and len(values) == 1 and not self._contest.reason:
            self._value = float(values[0])
        if len(self._heard) > 1:
            self._contest.extend(Contradiction.CHANGED, sorted(t for t, _ in self._heard.values())[-2], self._value)
        elif not self._contest.reason and len(values) and not self._is_believed(values).all():
            self._contest.extend(Contradiction.CHANGED, heard.end, self._value)
        replaced = self._contest.is_over(heard.end) and self._settle()
        if self._value in self._heard and not self._contest.reason:
            self.source = self._heard[self._value][1]
        taken = valid if self._contest.reason else valid & self._is_believed(heard.value)
        return Verdict(taken, self._contest.reason, replaced)

    def release(self) -> None:
        """End a contest; the value stays, for it is a constant of the vehicle, and any address may send it."""
        self.source, self._heard = self._configured, {}
        self._contest = Contest(self._patience)

    def state(self) -> dict[str, Any]:
        """The value, its sender and the contest."""
        return {"source": self.source, "value": self._value, "contest": self._contest.state()}

    def restore(self, state: State) -> None:
        """Go on where another choice was.

        Raises
        ------
        StateError
            The state is not that of such a choice.
        """
        source = read(state, "source", Address | None)
        self.source = source if self._configured is None else self._configured
        self._value = read(state, "value", float | None)
        self._contest.restore(substate(state, "contest"))

    def _is_believed(self, values: Floats) -> Mask:
        believed = np.nan if self._value is None else self._value
        close: Mask = np.abs(values - believed) <= self._step / 2
        return close

    def _settle(self) -> bool:
        """End the contest if one value alone has been sent; whether it is another one than before."""
        if len(self._heard) != 1:
            return False
        before = self._contest.before
        self._contest.settle()
        self._value = next(iter(self._heard))
        return before is not None and self._value != before


def choice(message: BoundMessage, bound: BoundSignal, settings: Bus) -> Choice:
    """How to choose the sender of a signal; where ids hold no address, all readings count as from address 0."""
    configured = message.source if message.by_pgn else NO_ADDRESS
    step = 0.0 if bound.signal.is_float else abs(float(bound.signal.scale) * bound.conversion.scale)
    if KIND.get(bound.role) is Kind.CONSTANT:
        return ConstantChoice(step, configured, settings)
    highest = fastest(message.cycle) if message.j1939 else np.inf
    return SenderChoice(bound.role, step, configured, highest, settings)

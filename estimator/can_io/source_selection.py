"""Choice of the address from which each signal is taken, and of the times in which none is used.

Traffic is judged in blocks of some seconds. The choice follows from the readings and can be revised:

* The first address is the one with the most valid readings in a block. If it is silent for ``release_s`` while another
  one sends, the other one is chosen.
* Readings that contradict each other (see `contradiction`) make a signal *contested*: no reading of it is used, until
  there has been no contradiction for ``contest_s``.
* After a contest the previous address is kept if it still sends. If another one replaces it, everything learnt from the
  first may be wrong: `Verdict.replaced`.

Times are those of messages, so live and replayed traffic are judged alike.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto
from typing import Annotated, Any, Protocol

import numpy as np
from msgspec import Meta

from estimator.can_io.binding import BoundMessage, BoundSignal
from estimator.can_io.contest import Contest
from estimator.can_io.contradiction import MAGNITUDE, Contradiction, are_alternating, are_flickering, is_disagreement
from estimator.can_io.heard import NO_ADDRESS, Heard
from estimator.can_io.own_rate import OwnRate, fastest
from estimator.checkpoint.validation import State, read, substate
from estimator.settings import Bus
from estimator.signals import DIMENSION, STATE, Floats, Mask, Role

Address = Annotated[int, Meta(ge=0, le=255)]

MIN_RIVAL_READINGS = 3  # readings in a block, below which a sender is no evidence against one with more


class Kind(Enum):
    """Use of a signal in the estimate."""

    MEASURED = auto()  # a term of the road load
    CONSTANT = auto()  # a property of the engine
    GATE = auto()  # excludes moments; several nodes may rightly send different values
    AUXILIARY = auto()  # refines


_KINDS = {
    Kind.MEASURED: (
        *(Role.SPEED, Role.WHEEL_SPEEDS, Role.ENGINE_POWER, Role.ENGINE_TORQUE, Role.ENGINE_SPEED),
        *(Role.TORQUE_FRACTION, Role.FRICTION_FRACTION, Role.PARASITIC_FRACTION),
        *(Role.BATTERY_VOLTAGE, Role.BATTERY_CURRENT),
    ),
    Kind.CONSTANT: (Role.REFERENCE_TORQUE,),
    Kind.GATE: (
        *(Role.GEAR, Role.BRAKE_SWITCH, Role.BRAKE_PEDAL, Role.CLUTCH_SWITCH, Role.SHIFT_IN_PROCESS),
        *(Role.DRIVELINE_ENGAGED, Role.RETARDER_FRACTION, Role.PARK_BRAKE),
    ),
}
KIND: dict[Role, Kind] = {role: kind for kind, roles in _KINDS.items() for role in roles}


@dataclass(frozen=True, slots=True)
class Verdict:
    """Mask ``taken`` (n,) of the readings of the chosen sender in a block.

    ``contested`` is the reason why they are not used, empty if they are. ``replaced`` is True if their sender replaces
    another one that was wrong, or that was never compared with this one.
    """

    taken: Mask
    contested: str = ""
    replaced: bool = False


class Choice(Protocol):
    """Interface for the choice of the sender of one signal, block by block."""

    source: int | None

    def judge(self, heard: Heard) -> Verdict:
        """Judge the next block."""

    def fast_path(self, heard: Heard) -> Callable[[], Verdict] | None:
        """Fast path: a function that judges all these blocks with one verdict; None if each must be judged alone."""

    def release(self, is_other_vehicle: bool) -> None:
        """Discard the choice: the next blocks may be of another vehicle or much later."""

    def state(self) -> dict[str, Any]:
        """State for `restore`."""

    def restore(self, state: State) -> None:
        """Take the state of another choice."""


class SenderChoice:
    """Chooses the address from which a varying signal is taken; see `choice`."""

    def __init__(
        self,
        role: Role,
        step: float,
        configured: int | None,
        highest_rate: float,
        settings: Bus,
        *,
        is_asked_for: bool = False,
    ) -> None:
        self.source = configured
        self._kind, self._is_state = KIND.get(role, Kind.AUXILIARY), DIMENSION[role] == STATE
        self._magnitude, self._step, self._configured = MAGNITUDE.get(role, 0.0), step, configured
        self._release, self._patience = settings.release_s, settings.contest_s
        self._rate = OwnRate(highest_rate, follows_value=role is Role.ENGINE_SPEED)
        # Engine and driveline have a retarder each, and each sends its own torque.
        self._is_of_all = role is Role.RETARDER_FRACTION and configured is None
        self._is_j1939 = bool(np.isfinite(highest_rate))  # how values alternate is known of its groups alone
        comes_alone = role is not Role.TORQUE_FRACTION  # which comes with the engine speed
        self._is_rated = self._kind is Kind.MEASURED and comes_alone and not is_asked_for
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
        return Verdict(self._taken(heard), self._contest.reason, replaced)

    def fast_path(self, heard: Heard) -> Callable[[], Verdict] | None:
        """Fast path if the present sender is in all blocks with a value, and nothing contradicts it; else None."""
        valid = heard.valid
        if self._configured is not None:
            valid = valid.of(valid.source == self._configured)
        rate = self._rate.copy()
        if self._contest.reason or (len(valid.t) and not self._is_calm(valid, rate)):
            return None
        last = {address: float(part.t[-1]) for address, part in valid.by_source().items()} if len(valid.t) else {}

        def take() -> Verdict:
            self._last |= last
            self._rate = rate
            return Verdict(self._taken(heard))

        return take

    def _is_calm(self, valid: Heard, rate: OwnRate) -> bool:
        readings = valid.of(self._is_chosen(valid))
        is_alone = len(readings.t) == len(valid.t)
        if not is_alone and self._kind is Kind.MEASURED:
            return False
        if not is_alone and np.any((np.diff(readings.bounds) == 0) & (np.diff(valid.bounds) > 0)):  # silent, others not
            return False
        if self._kind is Kind.AUXILIARY:
            return True
        return not (self._repeating(readings) or (self._is_rated and any(rate.exceeding(readings, self._step))))

    def _taken(self, heard: Heard) -> Mask:
        return np.ones(len(heard.t), dtype=np.bool_) if self._is_of_all else self._is_chosen(heard)

    def _is_chosen(self, heard: Heard) -> Mask:
        chosen: Mask = heard.source == (-1 if self.source is None else self.source)
        return chosen

    def release(self, is_other_vehicle: bool) -> None:
        """Discard the choice: the next blocks may be of another vehicle or much later."""
        self.source = self._configured
        self._last, self._agreed = {}, set()
        self._rate.forget()
        self._contest = Contest(self._patience)

    def state(self) -> dict[str, Any]:
        """State for `restore`: sender and contest, without the rates, which traffic shows again in seconds."""
        return {"source": self.source, "contest": self._contest.state()}

    def restore(self, state: State) -> None:
        """Take the state of another choice.

        Raises
        ------
        StateError
            The state is not that of such a choice.
        """
        source = read(state, "source", Address | None)
        self.source = source if self._configured is None else self._configured
        self._contest.restore(substate(state, "contest"))

    def _contradiction(self, senders: dict[int, Heard], end: float) -> str:
        """Contradiction in the readings of a block; empty without one."""
        if self._kind is Kind.AUXILIARY:
            return ""
        chosen = self.source if self.source in senders else next(iter(senders))
        readings = senders[chosen]
        if self._kind is Kind.MEASURED and not self._agree(readings, senders, chosen):
            return Contradiction.SENDERS_DISAGREE
        if self._repeating(readings):
            self._rate.doubt(end)
            return Contradiction.ALTERNATING
        if self._is_rated and any(self._rate.exceeding(readings, self._step)):
            return Contradiction.FASTER
        return ""

    def _repeating(self, readings: Heard) -> bool:
        """True if values alternate in any of the blocks."""
        if not self._is_j1939:
            return False
        bounds = readings.bounds
        bounds = bounds[np.flatnonzero(np.diff(bounds, prepend=-1))]  # of blocks with readings
        if self._is_state:
            return bool(are_flickering(readings.value, bounds).any())
        return bool(are_alternating(readings.value, bounds, self._magnitude, self._step).any())

    def _agree(self, readings: Heard, senders: dict[int, Heard], chosen: int) -> bool:
        """True if no other address contradicts the chosen one; stores the addresses that agree with it."""
        for address, other in senders.items():
            if address == chosen or len(other.t) < MIN_RIVAL_READINGS <= len(readings.t):
                continue
            differ = is_disagreement(readings.t, readings.value, other.t, other.value, self._magnitude, self._step)
            if differ:
                return False
            if differ is not None:
                self._agreed.add(address)
        return True

    def _settle(self, senders: dict[int, Heard], end: float) -> bool:
        """End the contest if an address sends; returns True if that replaces the previous one."""
        recent = [address for address, t in self._last.items() if t >= end - self._patience]
        previous = self._contest.before
        if not recent and self._kind is Kind.MEASURED:
            return False
        self._contest.settle()
        if previous in recent or not recent:
            self.source = self.source if previous is None else int(previous)
            return False
        self.source = next((address for address in senders), max(recent, key=lambda address: self._last[address]))
        return previous is not None

    def _follow(self, senders: dict[int, Heard], end: float) -> bool:
        """Choose the first sender, or another one if it is silent; returns True if an uncompared one replaces it."""
        if self.source in senders:
            return False
        previous, silent_since = self.source, self._last.setdefault(-1 if self.source is None else self.source, end)
        if previous is not None and end - silent_since < self._release:
            return False
        self.source = next(iter(senders))
        self._rate.forget()
        return previous is not None and self._kind is Kind.MEASURED and self.source not in self._agreed


class ConstantChoice:
    """Chooses the value of a constant and its sender; a different value from any address contests it."""

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

    def fast_path(self, heard: Heard) -> Callable[[], Verdict] | None:
        """Fast path if all values are the one in use; else None."""
        taken = np.isfinite(heard.value)
        if self._configured is not None:
            taken &= heard.source == self._configured
        sent = set(self._heard) | set(np.unique(heard.value[taken]).tolist())
        if self._contest.reason or not sent <= {self._value}:
            return None

        def take() -> Verdict:
            if taken.any() and self._value is not None:
                self.source = int(heard.source[taken][-1])
                self._heard[self._value] = float(heard.t[taken][-1]), self.source
            self._heard = {value: at for value, at in self._heard.items() if at[0] >= heard.end - self._patience}
            return Verdict(taken)

        return take

    def release(self, is_other_vehicle: bool) -> None:
        """End a contest, and keep the value unless the vehicle is another one; any address may then send it."""
        self.source, self._heard = self._configured, {}
        self._value = None if is_other_vehicle else self._value
        self._contest = Contest(self._patience)

    def state(self) -> dict[str, Any]:
        """State for `restore`: value, sender and contest."""
        return {"source": self.source, "value": self._value, "contest": self._contest.state()}

    def restore(self, state: State) -> None:
        """Take the state of another choice.

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
        """End the contest if only one value was sent lately; returns True if it differs from the previous one."""
        if len(self._heard) != 1:
            return False
        previous = self._contest.before
        self._contest.settle()
        self._value = next(iter(self._heard))
        return previous is not None and self._value != previous


def choice(message: BoundMessage, bound: BoundSignal, settings: Bus) -> Choice:
    """Return the choice of sender for a signal; if ids have no address, all readings count as from address 0."""
    configured = message.source if message.names_sender else NO_ADDRESS
    step = 0.0 if bound.signal.is_float else abs(float(bound.signal.scale) * bound.conversion.scale)
    if KIND.get(bound.role) is Kind.CONSTANT:
        return ConstantChoice(step, configured, settings)
    highest = fastest(message.cycle) if message.j1939 else np.inf
    # How often a multiplexer selects a signal is up to a tester's requests: no rate is its own.
    return SenderChoice(bound.role, step, configured, highest, settings, is_asked_for=bool(bound.multiplexers))

"""Frames to readings of the wanted signals, one block of traffic or many at a time.

Live traffic and logs go through the same code, so they give the same numbers. Frames and values that are refused are
counted by name.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.can_io.binding import BoundMessage, BoundSignal, last_byte
from estimator.can_io.carried import CarriedMessage, CarriedSignal, path_of
from estimator.can_io.contradiction import Contradiction
from estimator.can_io.frames import EXTENDED, Frames
from estimator.can_io.iso_tp import IsoTp, is_segmented
from estimator.can_io.j1939 import GROUP_MASK, PDU1_LIMIT, MultiPacket, Transport, pgn_of
from estimator.can_io.obd import is_answer
from estimator.can_io.signal_values import WORDS, needed_bytes
from estimator.can_io.source_selection import KIND, Kind, Verdict, choice
from estimator.checkpoint.validation import Count, State, read, substate
from estimator.errors import StateError
from estimator.settings import Bus
from estimator.signals import Floats, Mask, Role, Series

STRICTNESS = (Kind.AUXILIARY, Kind.GATE, Kind.CONSTANT, Kind.MEASURED)  # in what is asked of the senders, rising
NOTHING = Series(np.empty(0), np.empty(0))


@dataclass(frozen=True, slots=True)
class Decoded:
    """Readings by role, of blocks that end at ``ends`` (k,) [s]."""

    readings: dict[Role, list[Series]]
    ends: Floats


class Decoder:
    """Decodes batches of frames; its state is the senders of the signals, and unfinished broadcasts.

    Several nodes may send one parameter group, each filling in the signals it knows: each *signal* is taken from one
    source address, see `estimator.can_io.source_selection`. While an input of the road load is contested there, no
    such input is passed on.
    """

    def __init__(self, messages: list[BoundMessage], bus: Bus) -> None:
        self.used = 0  # frames that gave at least one signal
        self.rejected: Counter[str] = Counter()
        self.contested: dict[str, str] = {}  # reason by MESSAGE.signal, as of the last batch
        self.replaced = False  # in the last batch a sender was replaced because its readings were wrong
        self._messages = messages
        # Of two roles of one signal the stricter one counts.
        by_strictness = sorted([(m, b) for m in messages for b in m.signals], key=lambda pair: _strictness(pair[1]))
        self._choices = {path_of(m, b): choice(m, b, bus) for m, b in by_strictness}
        self._with_sender = {path_of(m, b) for m in messages if m.names_sender for b in m.signals}
        paths = Counter(path_of(m, b) for m in messages for b in m.signals)
        self._shared = {path for path, count in paths.items() if count > 1}  # by several roles
        self._places = Counter(bound.role for message in messages for bound in message.signals)
        self._needs = [needed_bytes(message) for message in messages]
        self._reaches = [max(last_byte(s) for b in m.signals for s in (b.signal, *b.multiplexers)) for m in messages]
        self._transport = Transport()
        self._seen: set[str] = set()  # names of messages that came
        self._groups_seen: set[str] = set()  # and of those matched by their whole id, whose group came
        self._iso_tp = {message.name: IsoTp(message) for message in messages if is_segmented(message)}

    @property
    def sources(self) -> dict[str, int]:
        """Chosen source address of each signal of J1939 or OBD-II, by MESSAGE.signal, where it is known."""
        sources = {path: self._choices[path].source for path in self._choices if path in self._with_sender}
        return {path: source for path, source in sources.items() if source is not None}

    @property
    def sent_by_others(self) -> list[str]:
        """Messages matched by their whole id of which only others of the same parameter group came."""
        return sorted(self._groups_seen - self._seen)

    @property
    def transport_rejected(self) -> Counter[str]:
        """Broken multi-packet messages, by reason."""
        return sum((joiner.rejected for joiner in self._iso_tp.values()), self._transport.rejected)

    def release(self, is_other_vehicle: bool = False) -> None:
        """Discard the chosen senders: another node, or that of another vehicle, may send now."""
        for sender_choice in self._choices.values():
            sender_choice.release(is_other_vehicle)
        self.contested = {}

    def state(self) -> dict[str, Any]:
        """State for `restore`: senders and counts, without unfinished broadcasts."""
        return {
            "choices": {path: sender_choice.state() for path, sender_choice in self._choices.items()},
            "contested": dict(self.contested),
            "used": self.used,
            "rejected": dict(self.rejected),
            "transport": dict(self.transport_rejected),
        }

    def restore(self, state: State) -> None:
        """Take the state of another decoder of the same messages.

        Raises
        ------
        StateError
            The state is not that of such a decoder.
        """
        choices, contested = substate(state, "choices"), read(state, "contested", dict[str, Contradiction])
        if set(choices) != set(self._choices) or not set(contested) <= set(choices):
            raise StateError("choices: of other signals than are bound")
        for path, sender_choice in self._choices.items():
            sender_choice.restore(substate(choices, path))
        self.contested = contested
        self.used = read(state, "used", Count)
        self.rejected = Counter(read(state, "rejected", dict[str, Count]))
        self._transport.rejected.update(read(state, "transport", dict[str, Count]))

    def decode(self, frames: Frames, end: float | None = None) -> dict[Role, list[Series]]:
        """Decode one block of frames to SI; a role bound to several signals has a series for each, possibly empty.

        Senders are judged block by block, so the result depends on how traffic is cut: give blocks of a few seconds.
        ``end`` is the time at which the block ends [s], by default that of its last frame.
        """
        end = end if end is not None else float(frames.t[-1]) if len(frames) else -np.inf
        return next(self.decode_blocks(frames, np.array([end]))).readings

    def decode_blocks(self, frames: Frames, ends: Floats) -> Iterator[Decoded]:
        """Decode frames, in order of time, in blocks that end at ``ends`` (k,) [s].

        Blocks in which no sender changes or is contradicted are judged together, with the result of one by one.
        """
        yield from self._judged(self._carried(frames, ends), ends)

    def _carried(self, frames: Frames, ends: Floats) -> list[CarriedMessage]:
        """Signals of each message in the frames that are long enough."""
        group = frames.ident & np.uint32(GROUP_MASK)
        packets = self._transport.feed(frames)
        carried = []
        for message, need, reach in zip(self._messages, self._needs, self._reaches, strict=True):
            chosen = frames[is_message(message, frames.ident, group)]
            self._note_presence(message, bool(len(chosen)), group, packets)
            if message.name in self._iso_tp:
                chosen = self._iso_tp[message.name].feed(chosen)
            chosen = chosen.widened(reach)
            whole = chosen.length >= need
            broadcasts = [packet for packet in packets if message.by_pgn and packet.pgn == message.key]
            long = [packet for packet in broadcasts if len(packet.payload) >= need]
            if short := int(np.count_nonzero(~whole)) + len(broadcasts) - len(long):
                self.rejected[f"{message.name}: short frame"] += short
                chosen = chosen[whole]
            if long:
                chosen = Frames.concatenate([chosen, stacked(long, reach)])
                chosen = chosen[np.argsort(chosen.t, kind="stable")]
            carried.append(CarriedMessage.of(message, chosen, ends))
        return carried

    def _note_presence(
        self, message: BoundMessage, is_there: bool, group: NDArray[np.uint32], packets: list[MultiPacket]
    ) -> None:
        """Note whether frames of a message came, or only frames of its parameter group."""
        if is_there:
            self._seen.add(message.name)
        elif not message.by_pgn and message.key & EXTENDED and message.name not in self._seen | self._groups_seen:
            pgn = int(pgn_of(np.array([message.key], dtype=np.uint32))[0])
            if is_group(pgn, group).any() or any(packet.pgn == pgn for packet in packets):
                self._groups_seen.add(message.name)

    def _judged(self, carried: list[CarriedMessage], ends: Floats) -> Iterator[Decoded]:
        """Judge all blocks together if no signal must be judged block by block, else each half of them."""
        judges = [
            judge for message in carried for signal in message.signals if (judge := self._judge(signal)) is not None
        ]
        if len(judges) < sum(len(message.signals) for message in carried):
            halves = [message.halves(ends) for message in carried]
            half = len(ends) // 2
            yield from self._judged([first for first, _ in halves], ends[:half])
            yield from self._judged([second for _, second in halves], ends[half:])
            return
        self.replaced = False
        out: dict[Role, list[Series]] = {}
        verdicts = iter([judge() for judge in judges])
        for message in carried:
            self._take_message(message, list(islice(verdicts, len(message.signals))), out)
        if self.contested:
            self._withhold(out)
        yield Decoded(out, ends)

    def _judge(self, carried: CarriedSignal) -> Callable[[], Verdict] | None:
        """Return a function that judges a signal in these blocks; None if they must be judged one by one."""
        choice = self._choices[carried.path]
        if len(carried.heard.ends) == 1:
            return partial(choice.judge, carried.heard)
        return None if carried.path in self._shared else choice.fast_path(carried.heard)

    def _take_message(self, carried: CarriedMessage, verdicts: list[Verdict], out: dict[Role, list[Series]]) -> None:
        """Add the usable readings of a message to ``out``, and count its frames."""
        every = [self._take(signal, verdict, out) for signal, verdict in zip(carried.signals, verdicts, strict=True)]
        count = len(carried.t)
        if any(every):
            self.used += count
            return
        useful, spoken_for, carrying = np.zeros((3, count), dtype=bool)
        for signal, verdict in zip(carried.signals, verdicts, strict=True):
            here = signal.of_message(np.ones(len(signal.heard.t), dtype=bool), count)
            carrying |= here
            useful |= signal.of_message(verdict.taken, count)
            if self._choices[signal.path].source is not None:
                spoken_for |= here
        self.used += int(np.count_nonzero(useful))
        idle = carrying & ~useful
        for reason, mask in (("other source address", idle & spoken_for), ("no valid value", idle & ~spoken_for)):
            if number := int(np.count_nonzero(mask)):
                self.rejected[f"{carried.message.name}: {reason}"] += number

    def _take(self, carried: CarriedSignal, verdict: Verdict, out: dict[Role, list[Series]]) -> bool:
        """Add the usable readings of a signal to ``out``, NaN if contested; returns True if every frame gave one."""
        path, bound, taken, value = carried.path, carried.bound, verdict.taken, carried.heard.value
        self.replaced |= verdict.replaced
        for reason, mask in carried.masks.items():
            if count := int(np.count_nonzero(mask & taken)):
                self.rejected[f"{path}: {reason}"] += count
        if verdict.contested:
            self.contested[path] = verdict.contested
            if count := int(np.count_nonzero(np.isfinite(value[taken]))):
                self.rejected[f"{path}: contested, {verdict.contested}"] += count
            value = np.full(len(value), np.nan)
        else:
            self.contested.pop(path, None)
        number = int(np.count_nonzero(taken))
        is_whole = number == len(taken)
        if number:
            places = out.setdefault(bound.role, [NOTHING] * self._places[bound.role])
            t = carried.heard.t
            places[bound.place] = Series(t, value) if is_whole else Series(t[taken], value[taken])
        return is_whole and carried.frames is None

    def _withhold(self, out: dict[Role, list[Series]]) -> None:
        """Set all inputs of the road load to NaN: without the contested one, an estimate is impossible or wrong."""
        for role, parts in out.items():
            if KIND.get(role) is not Kind.MEASURED:
                continue
            lost = sum(int(np.isfinite(part.value).sum()) for part in parts)
            if lost:
                self.rejected[f"{role.value}: another input is contested"] += lost
            out[role] = [Series(part.t, np.full(len(part.t), np.nan)) for part in parts]


def _strictness(bound: BoundSignal) -> int:
    return STRICTNESS.index(KIND.get(bound.role, Kind.AUXILIARY))


def is_message(message: BoundMessage, ident: NDArray[np.uint32], group: NDArray[np.uint32]) -> Mask:
    """Mask (n,) of the ids of a message; ``group`` (n,) are the ids without priority and source address."""
    if message.of_any_ecu:
        return is_answer(ident)
    if message.by_pgn:
        return is_group(message.key, group)
    is_same: Mask = ident == message.key
    return is_same


def is_group(pgn: int, group: NDArray[np.uint32]) -> Mask:
    """Mask (n,) of ids of a parameter group; ``group`` (n,) are the ids without priority and source address."""
    if pgn >> 8 & 0xFF < PDU1_LIMIT:  # the low byte is a destination
        group = group & np.uint32(0xFFFF0000)
    is_of_group: Mask = group == EXTENDED | pgn << 8
    return is_of_group


def stacked(packets: list[MultiPacket], reach: int) -> Frames:
    """Reassembled messages as frames, cut or zero-filled to whole words of at least ``reach`` bytes."""
    width = -(-reach // WORDS[-1]) * WORDS[-1]
    rows = [np.frombuffer(p.payload[:width].ljust(width, b"\0"), dtype=np.uint8) for p in packets]
    return Frames(
        np.array([p.t for p in packets], dtype=np.float64),
        np.array([EXTENDED | p.pgn << 8 | p.source for p in packets], dtype=np.uint32),
        np.array([len(p.payload) for p in packets], dtype=np.uint16),
        np.array(rows, dtype=np.uint8),
    )

"""Frames to signals: bits to SI values, whole batches at a time.

Live traffic and logs go through the same code, so they give the same numbers. A value that its sender marks as
not available, as an error, or that lies outside its declared range becomes NaN and is counted by name.
"""

import math
from collections import Counter
from itertools import pairwise
from typing import Any

import numpy as np
from cantools.database.can import Signal
from numpy.typing import NDArray

from estimator.can_io.binding import BoundMessage, BoundSignal
from estimator.can_io.contradiction import Contradiction
from estimator.can_io.frames import EXTENDED, Frames
from estimator.can_io.j1939 import GROUP_MASK, PDU1_LIMIT, MultiPacket, Transport, classify, highest_valid
from estimator.can_io.source_selection import KIND, NO_ADDRESS, Heard, Kind, choice
from estimator.checkpoint.validation import Count, State, read, substate
from estimator.errors import StateError
from estimator.settings import Bus
from estimator.signals import Floats, Mask, Role, Series

Raw = NDArray[np.unsignedinteger[Any]]
WORDS = (1, 2, 4, 8)  # bytes
EXACT_BITS = 53  # of a raw value that a floating-point number holds exactly


def extract(data: NDArray[np.uint8], signal: Signal) -> Raw:
    """Raw bits (n,) of a signal of at most 64 bits from payloads (n, whole words), byte order as the DBC says."""
    little = signal.byte_order == "little_endian"
    # The DBC's start bit of a big-endian signal is its most significant one, counted in its byte from the lowest.
    first = signal.start if little else signal.start // 8 * 8 + 7 - signal.start % 8
    last = first + signal.length - 1
    size = next((size for size in WORDS if first // (8 * size) == last // (8 * size)), None)
    if size is None:
        return _extract_across_words(data, signal)
    column, bit = divmod(first, 8 * size)
    word: Raw = np.ascontiguousarray(data).view(f"{'<' if little else '>'}u{size}")[:, column]
    shift = bit if little else 8 * size - bit - signal.length
    if shift:
        word = word >> word.dtype.type(shift)
    return word if shift + signal.length == 8 * size else word & word.dtype.type((1 << signal.length) - 1)


def _extract_across_words(data: NDArray[np.uint8], signal: Signal) -> Raw:
    """The same byte by byte."""
    if signal.byte_order == "little_endian":
        first, shift = divmod(signal.start, 8)
        count = (shift + signal.length + 7) // 8
        columns = range(first, first + count)
    else:
        first, bit = divmod(signal.start, 8)
        count = (7 - bit + signal.length + 7) // 8
        shift = 8 * count - (7 - bit) - signal.length
        columns = range(first + count - 1, first - 1, -1)
    raw = np.zeros(len(data), dtype=np.uint64)
    for place, column in enumerate(columns):
        byte = data[:, column].astype(np.uint64)
        move = 8 * place - shift
        raw |= byte << np.uint64(move) if move >= 0 else byte >> np.uint64(-move)
    return raw & np.uint64((1 << signal.length) - 1)


def last_byte(signal: Signal) -> int:
    """Number of payload bytes that a frame needs to carry the whole signal."""
    if signal.byte_order == "little_endian":
        return (signal.start + signal.length + 7) // 8
    first, bit = divmod(signal.start, 8)
    return first + (7 - bit + signal.length + 7) // 8


def _number(raw: Raw, signal: Signal) -> Floats:
    """Scaled value in the DBC's own unit."""
    if signal.is_float:
        kinds = {16: (np.uint16, np.float16), 32: (np.uint32, np.float32), 64: (np.uint64, np.float64)}
        integer, real = kinds[signal.length]
        value = raw.astype(integer).view(real).astype(np.float64)
    elif signal.is_signed:
        top = np.uint64(64 - signal.length)
        value = ((raw.astype(np.uint64) << top).view(np.int64) >> np.int64(top)).astype(np.float64)
    else:
        value = raw.astype(np.float64)
    return _scaled(value, float(signal.scale), float(signal.offset))


def _scaled(value: Floats, scale: float, offset: float) -> Floats:
    """The same array, scaled and shifted in place."""
    if scale != 1:
        value *= scale
    if offset != 0:
        value += offset
    return value


NOTHING = Series(np.empty(0), np.empty(0))


class Decoder:
    """Decodes batches; its state is the senders of the signals, and unfinished broadcasts.

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
        self._choices = {_path(m, b): choice(m, b, bus) for m in messages for b in m.signals}
        self._by_pgn = {_path(m, b) for m in messages if m.by_pgn for b in m.signals}
        self._places = Counter(bound.role for message in messages for bound in message.signals)
        self._needs = [max(last_byte(s) for b in m.signals for s in (b.signal, *b.multiplexers)) for m in messages]
        self._transport = Transport()

    @property
    def sources(self) -> dict[str, int]:
        """Source address that each J1939 signal is taken from, by MESSAGE.signal, where it is known."""
        found = {path: self._choices[path].source for path in self._choices if path in self._by_pgn}
        return {path: source for path, source in found.items() if source is not None}

    @property
    def transport_rejected(self) -> Counter[str]:
        """Broken multi-packet broadcasts, by reason."""
        return self._transport.rejected

    def release(self) -> None:
        """Choose the senders again: another node may send now."""
        for each in self._choices.values():
            each.release()
        self.contested = {}

    def state(self) -> dict[str, Any]:
        """The senders and the counts; not the broadcasts that are under way."""
        return {
            "choices": {path: each.state() for path, each in self._choices.items()},
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
        for path, each in self._choices.items():
            each.restore(substate(choices, path))
        self.contested = contested
        self.used = read(state, "used", Count)
        self.rejected = Counter(read(state, "rejected", dict[str, Count]))
        self.transport_rejected.update(read(state, "transport", dict[str, Count]))

    def decode(self, frames: Frames, end: float | None = None) -> dict[Role, list[Series]]:
        """Signals in a batch of frames, in SI; a role bound to several has a series for each, empty or not.

        Senders are judged batch by batch, so what is contested depends on how traffic is cut: give batches of a few
        seconds. ``end`` is the time at which this one ends [s], by default that of its last frame.
        """
        out: dict[Role, list[Series]] = {}
        group = frames.ident & np.uint32(GROUP_MASK)
        packets = self._transport.feed(frames)
        end = end if end is not None else float(frames.t[-1]) if len(frames) else -np.inf
        self.replaced = False
        for message, need in zip(self._messages, self._needs, strict=True):
            chosen = frames[_is_message(message, frames.ident, group)]
            if message.by_pgn and (broadcasts := [p for p in packets if p.pgn == message.key]):
                chosen = Frames.concatenate([chosen, _stack(broadcasts, need)])
                chosen = chosen[np.argsort(chosen.t, kind="stable")]
            if len(chosen) and chosen.length.min() < need:
                whole = chosen.length >= need
                self.rejected[f"{message.name}: short frame"] += int(np.count_nonzero(~whole))
                chosen = chosen[whole]
            self._decode_message(message, chosen, end, out)
        if self.contested:
            self._withhold(out)
        return out

    def _decode_message(self, message: BoundMessage, frames: Frames, end: float, out: dict[Role, list[Series]]) -> None:
        useful, spoken_for, carrying = np.zeros((3, len(frames)), dtype=bool)
        source = _sources(message, frames)
        for bound in message.signals:
            if not bound.multiplexers or not len(frames):
                taken = self._take(message, bound, frames, source, end, out)
                here = np.ones(len(frames), dtype=bool)
            else:
                here = _present(bound, frames)
                taken = np.zeros(len(frames), dtype=bool)
                taken[here] = self._take(message, bound, frames[here], source[here], end, out)
            carrying |= here
            useful |= taken
            if self._choices[_path(message, bound)].source is not None:
                spoken_for |= here
        self.used += int(np.count_nonzero(useful))
        idle = carrying & ~useful
        for reason, mask in (("other source address", idle & spoken_for), ("no valid value", idle & ~spoken_for)):
            if count := int(np.count_nonzero(mask)):
                self.rejected[f"{message.name}: {reason}"] += count

    def _take(
        self,
        message: BoundMessage,
        bound: BoundSignal,
        part: Frames,
        source: NDArray[np.uint8],
        end: float,
        out: dict[Role, list[Series]],
    ) -> Mask:
        """Add the readings of one signal that may be used, NaN where it is contested; returns their mask (n,)."""
        path = _path(message, bound)
        value, masks = _values(message, bound, part) if len(part) else (np.empty(0), {})
        verdict = self._choices[path].judge(Heard(part.t, source, value, end))
        taken = verdict.taken
        self.replaced |= verdict.replaced
        for reason, mask in masks.items():
            if count := int(np.count_nonzero(mask & taken)):
                self.rejected[f"{path}: {reason}"] += count
        if verdict.contested:
            self.contested[path] = verdict.contested
            if count := int(np.count_nonzero(np.isfinite(value[taken]))):
                self.rejected[f"{path}: contested, {verdict.contested}"] += count
            value = np.full(len(value), np.nan)
        else:
            self.contested.pop(path, None)
        if taken.any():
            places = out.setdefault(bound.role, [NOTHING] * self._places[bound.role])
            places[bound.place] = Series(part.t, value) if taken.all() else Series(part.t[taken], value[taken])
        return taken

    def _withhold(self, out: dict[Role, list[Series]]) -> None:
        """Make every input of the road load unknown: without one of them, the others give no or a wrong estimate."""
        for role, parts in out.items():
            if KIND.get(role) is not Kind.MEASURED:
                continue
            known = sum(int(np.isfinite(part.value).sum()) for part in parts)
            if known:
                self.rejected[f"{role.value}: another input is contested"] += known
            out[role] = [Series(part.t, np.full(len(part.t), np.nan)) for part in parts]


def _sources(message: BoundMessage, frames: Frames) -> NDArray[np.uint8]:
    """Source address (n,) of each frame, NO_ADDRESS where the id holds none."""
    if not message.by_pgn:
        return np.full(len(frames), NO_ADDRESS, np.uint8)
    return (frames.ident & np.uint32(0xFF)).astype(np.uint8)


def _is_message(message: BoundMessage, ident: NDArray[np.uint32], group: NDArray[np.uint32]) -> Mask:
    """Which ids (n,) are those of a message; ``group`` is what they have without priority and source address."""
    if not message.by_pgn:
        found: Mask = ident == message.key
    elif message.key >> 8 & 0xFF < PDU1_LIMIT:  # the low byte is a destination
        found = group & np.uint32(0xFFFF0000) == EXTENDED | message.key << 8
    else:
        found = group == EXTENDED | message.key << 8
    return found


def _present(bound: BoundSignal, frames: Frames) -> Mask:
    """In which frames the multiplexers of a signal select it."""
    here = np.ones(len(frames), dtype=bool)
    for signal, multiplexer in pairwise((bound.signal, *bound.multiplexers)):
        selecting = np.array(signal.multiplexer_ids or [], dtype=np.uint64)
        here &= np.isin(extract(frames.data, multiplexer), selecting)
    return here


def _values(message: BoundMessage, bound: BoundSignal, frames: Frames) -> tuple[Floats, dict[str, Mask]]:
    """SI values, NaN where the sender gave none, and where for which reason."""
    signal, conversion = bound.signal, bound.conversion
    raw = extract(frames.data, signal)
    with np.errstate(over="ignore", invalid="ignore"):  # floating-point signals may hold anything
        value = _number(raw, signal)
        if _are_all_usual(message, bound, value):
            return _scaled(value, conversion.scale, conversion.offset), {}
        si = _scaled(value.copy(), conversion.scale, conversion.offset)
        if bound.tangent:
            np.tan(si, out=si)
    masks = _no_values(message, signal, raw, value, np.isfinite(si))
    for mask in masks.values():
        si[mask] = np.nan
    return si, masks


def _are_all_usual(message: BoundMessage, bound: BoundSignal, value: Floats) -> bool:
    """Whether the extremes show that every scaled value (n,) of a linear signal is one."""
    signal, conversion = bound.signal, bound.conversion
    if signal.is_float or bound.tangent or signal.length > EXACT_BITS or not len(value):
        return False
    low, high = _range(signal)
    if message.j1939 and not signal.is_signed:
        edge = highest_valid(signal.length) * float(signal.scale) + float(signal.offset)
        low, high = (low, min(high, edge)) if signal.scale > 0 else (max(low, edge), high)
    least, most = float(value.min()), float(value.max())
    extremes = least * conversion.scale + conversion.offset, most * conversion.scale + conversion.offset
    return low <= least and most <= high and all(map(math.isfinite, extremes))


def _range(signal: Signal) -> tuple[float, float]:
    """The scaled values that the DBC allows."""
    low, high = signal.minimum, signal.maximum
    if low is None or high is None or not low < high:
        return -math.inf, math.inf
    room = abs(float(signal.scale)) / 2  # half a bit: ranges in DBC files are often written rounded
    return float(low) - room, float(high) + room


def _no_values(message: BoundMessage, signal: Signal, raw: Raw, value: Floats, finite: Mask) -> dict[str, Mask]:
    """Where there is no value (n,) and why, each with the first reason."""
    masks: dict[str, Mask] = {}
    left = np.ones(len(raw), dtype=bool)
    if message.j1939 and not signal.is_signed:
        masks["not available"], masks["error"], masks["reserved value"] = classify(raw, signal.length)
        left = ~np.any(list(masks.values()), axis=0)
    masks["not a number"] = left & ~finite
    low, high = _range(signal)
    masks["out of range"] = left & finite & ((value < low) | (value > high))
    return masks


def _path(message: BoundMessage, bound: BoundSignal) -> str:
    return f"{message.name}.{bound.signal.name}"


def _stack(packets: list[MultiPacket], need: int) -> Frames:
    """Reassembled messages in the form of frames, cut or zero-filled to words that hold the ``need`` bytes wanted."""
    width = -(-need // WORDS[-1]) * WORDS[-1]
    rows = [np.frombuffer(p.payload[:width].ljust(width, b"\0"), dtype=np.uint8) for p in packets]
    return Frames(
        np.array([p.t for p in packets], dtype=np.float64),
        np.array([EXTENDED | p.pgn << 8 | p.source for p in packets], dtype=np.uint32),
        np.array([min(len(p.payload), 255) for p in packets], dtype=np.uint8),
        np.array(rows, dtype=np.uint8),
    )

"""Frames to signals: bits to SI values, whole batches at a time.

Live traffic and logs go through the same code, so they give the same numbers. A value that its sender marks as
not available, as an error, or that lies outside its declared range becomes NaN and is counted by name.
"""

from collections import Counter
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from cantools.database.can import Signal
from msgspec import Meta
from numpy.typing import NDArray

from estimator.can_io.binding import BoundMessage, BoundSignal
from estimator.can_io.frames import EXTENDED, Frames
from estimator.can_io.j1939 import MultiPacket, Transport, classify, pgn_of
from estimator.errors import StateError
from estimator.signals import Floats, Mask, Role, Series
from estimator.state import Count, State, read

Raw = NDArray[np.uint64]


def extract(data: NDArray[np.uint8], signal: Signal) -> Raw:
    """Raw bits (n,) of a signal of at most 64 bits from payloads (n, width), byte order as the DBC says."""
    if signal.byte_order == "little_endian":
        first, shift = divmod(signal.start, 8)
        count = (shift + signal.length + 7) // 8
        columns = range(first, first + count)
    else:
        # DBC start bit of a big-endian signal is its most significant bit, counted within its byte from bit 0.
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
        value = ((raw << top).view(np.int64) >> np.int64(top)).astype(np.float64)
    else:
        value = raw.astype(np.float64)
    return value * float(signal.scale) + float(signal.offset)


NOTHING = Series(np.empty(0), np.empty(0))


class Decoder:
    """Keeps what decoding must remember between batches: who sends which signal, and unfinished broadcasts.

    Several nodes may send one parameter group, each filling in the signals it knows: each *signal* is taken from
    one source address, the first that sends a valid value of it, or the one that was configured.
    """

    def __init__(self, messages: list[BoundMessage]) -> None:
        self.used = 0  # frames that gave at least one signal
        self.rejected: Counter[str] = Counter()
        self._messages = messages
        self.sources = self._configured()  # by MESSAGE.signal
        self._places = Counter(bound.role for message in messages for bound in message.signals)
        self._needs = [max(last_byte(s) for b in m.signals for s in (b.signal, *b.multiplexers)) for m in messages]
        self._transport = Transport()

    @property
    def transport_rejected(self) -> Counter[str]:
        """Broken multi-packet broadcasts, by reason."""
        return self._transport.rejected

    def _configured(self) -> dict[str, int]:
        """Sources that need not be found."""
        given = [message for message in self._messages if message.source is not None]
        return {_path(m, bound): m.source for m in given for bound in m.signals if m.source is not None}

    def release(self) -> None:
        """Let go of the sources that were found: another node may speak now."""
        self.sources = self._configured()

    def state(self) -> dict[str, Any]:
        """Who sends what, and the counts; not the broadcasts that are under way."""
        return {
            "sources": dict(self.sources),
            "used": self.used,
            "rejected": dict(self.rejected),
            "transport": dict(self.transport_rejected),
        }

    def restore(self, state: State) -> None:
        """Go on where another decoder of the same messages was.

        Raises
        ------
        StateError
            The state is not that of such a decoder.
        """
        sources = read(state, "sources", dict[str, Annotated[int, Meta(ge=0, le=255)]])
        if not set(sources) <= {_path(message, bound) for message in self._messages for bound in message.signals}:
            raise StateError("sources: of signals that are not bound")
        self.sources = sources | self._configured()
        self.used = read(state, "used", Count)
        self.rejected = Counter(read(state, "rejected", dict[str, Count]))
        self.transport_rejected.update(read(state, "transport", dict[str, Count]))

    def decode(self, frames: Frames) -> dict[Role, list[Series]]:
        """Signals in a batch of frames, in SI; a role bound to several has a series for each, empty or not."""
        out: dict[Role, list[Series]] = {}
        extended = frames.ident & EXTENDED != 0
        pgn = np.where(extended, pgn_of(frames.ident), np.uint32(0xFFFFFFFF))
        packets = self._transport.feed(frames)
        for message, need in zip(self._messages, self._needs, strict=True):
            chosen = frames[(pgn if message.by_pgn else frames.ident) == message.key]
            if message.by_pgn and (broadcasts := [p for p in packets if p.pgn == message.key]):
                chosen = Frames.concatenate([chosen, _stack(broadcasts, need)])
                chosen = chosen[np.argsort(chosen.t, kind="stable")]
            whole = chosen.length >= need
            if not whole.all():
                self.rejected[f"{message.name}: short frame"] += int((~whole).sum())
                chosen = chosen[whole]
            if len(chosen):
                self._decode_message(message, chosen, out)
        return out

    def _decode_message(self, message: BoundMessage, frames: Frames, out: dict[Role, list[Series]]) -> None:
        useful, spoken_for, carrying = np.zeros((3, len(frames)), dtype=bool)
        for bound in message.signals:
            here = _present(bound, frames)
            carrying |= here
            if message.by_pgn:
                since = self._find_source(message, bound, frames, here)
                spoken_for[since:] |= here[since:]
                here[:since] = False
                here &= frames.ident & 0xFF == self.sources.get(_path(message, bound), -1)
            if not here.any():
                continue
            useful |= here
            part = frames[here]
            value, counts = _values(message, bound, part)
            for reason, count in counts.items():
                self.rejected[f"{_path(message, bound)}: {reason}"] += count
            places = out.setdefault(bound.role, [NOTHING] * self._places[bound.role])
            places[bound.place] = Series(part.t, value)
        self.used += int(useful.sum())
        idle = carrying & ~useful
        for reason, mask in (("other source address", idle & spoken_for), ("no valid value", idle & ~spoken_for)):
            if mask.any():
                self.rejected[f"{message.name}: {reason}"] += int(mask.sum())

    def _find_source(self, message: BoundMessage, bound: BoundSignal, frames: Frames, here: Mask) -> int:
        """From which of the frames on somebody speaks for a signal; as many as there are if nobody does yet."""
        path = _path(message, bound)
        if path in self.sources:
            return 0
        places = np.flatnonzero(here)
        valid = places[np.isfinite(_values(message, bound, frames[places])[0])]
        if not len(valid):
            return len(frames)
        self.sources[path] = int(frames.ident[valid[0]] & 0xFF)
        return int(valid[0])


def _present(bound: BoundSignal, frames: Frames) -> Mask:
    """In which frames the multiplexers of a signal select it."""
    here = np.ones(len(frames), dtype=bool)
    for signal, multiplexer in pairwise((bound.signal, *bound.multiplexers)):
        selecting = np.array(signal.multiplexer_ids or [], dtype=np.uint64)
        here &= np.isin(extract(frames.data, multiplexer), selecting)
    return here


def _values(message: BoundMessage, bound: BoundSignal, frames: Frames) -> tuple[Floats, Counter[str]]:
    """SI values, NaN where the sender gave none, and how many for which reason."""
    signal, conversion = bound.signal, bound.conversion
    raw = extract(frames.data, signal)
    masks: dict[str, Mask] = {}
    with np.errstate(over="ignore", invalid="ignore"):  # floating-point signals may hold anything
        value = _number(raw, signal)
        si = value * conversion.scale + conversion.offset
        if bound.tangent:
            si = np.tan(si)
    if message.j1939 and not signal.is_signed:
        masks["not available"], masks["error"], masks["reserved value"] = classify(raw, signal.length)
    valued = ~np.any([np.zeros(len(raw), dtype=bool), *masks.values()], axis=0)
    masks["not a number"] = valued & ~np.isfinite(si)
    valued &= np.isfinite(si)
    low, high = signal.minimum, signal.maximum
    if low is not None and high is not None and low < high:
        # Half a bit of room: ranges in DBC files are often written rounded.
        room = abs(float(signal.scale)) / 2
        masks["out of range"] = valued & ((value < float(low) - room) | (value > float(high) + room))
    counts = Counter({reason: int(mask.sum()) for reason, mask in masks.items() if mask.any()})
    si[np.any(list(masks.values()), axis=0)] = np.nan
    return si, counts


def _path(message: BoundMessage, bound: BoundSignal) -> str:
    return f"{message.name}.{bound.signal.name}"


def _stack(packets: list[MultiPacket], width: int) -> Frames:
    """Reassembled messages in the form of frames, cut or zero-filled to the bytes that are wanted."""
    rows = [np.frombuffer(p.payload[:width].ljust(width, b"\0"), dtype=np.uint8) for p in packets]
    return Frames(
        np.array([p.t for p in packets], dtype=np.float64),
        np.array([EXTENDED | p.pgn << 8 | p.source for p in packets], dtype=np.uint32),
        np.array([min(len(p.payload), 255) for p in packets], dtype=np.uint8),
        np.array(rows, dtype=np.uint8),
    )

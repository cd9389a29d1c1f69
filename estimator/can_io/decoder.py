"""Frames to signals: bits to SI values, whole batches at a time.

Live traffic and logs go through the same code, so they give the same numbers. A value that its sender marks as
not available, as an error, or that lies outside its declared range becomes NaN and is counted by name.
"""

from collections import Counter

import numpy as np
from cantools.database.can import Signal
from numpy.typing import NDArray

from estimator.can_io.binding import BoundMessage, BoundSignal
from estimator.can_io.frames import CLASSIC_BYTES, EXTENDED, Frames
from estimator.can_io.j1939 import MultiPacket, Transport, classify, pgn_of
from estimator.signals import Floats, Mask, Role, Series

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


class Decoder:
    """Keeps what decoding must remember between batches: who sends which signal, and unfinished broadcasts.

    Several nodes may send one parameter group, each filling in the signals it knows: each *signal* is taken from
    one source address, the first that sends valid values of it, or the one that was configured.
    """

    def __init__(self, messages: list[BoundMessage]) -> None:
        self.used = 0  # frames that gave at least one signal
        self.rejected: Counter[str] = Counter()
        self.sources: dict[str, int] = {}  # by MESSAGE.signal
        for message in messages:
            if message.source is not None:
                self.sources |= {_path(message, bound): message.source for bound in message.signals}
        self._messages = messages
        self._needs = {m.name: max(last_byte(s.signal) for s in m.signals) for m in messages}
        self._transport = Transport()

    @property
    def transport_rejected(self) -> Counter[str]:
        """Broken multi-packet broadcasts, by reason."""
        return self._transport.rejected

    def decode(self, frames: Frames) -> dict[Role, list[Series]]:
        """Signals in a batch of frames, in SI; roles bound to several signals have several series."""
        out: dict[Role, list[Series]] = {}
        extended = frames.ident & EXTENDED != 0
        pgn = np.where(extended, pgn_of(frames.ident), np.uint32(0xFFFFFFFF))
        packets = self._transport.feed(frames)
        for message in self._messages:
            if message.by_pgn and message.length > CLASSIC_BYTES:
                chosen = _stack([p for p in packets if p.pgn == message.key], message.length)
            else:
                chosen = frames[(pgn if message.by_pgn else frames.ident) == message.key]
            if len(chosen):
                self._decode_message(message, chosen, out)
        return out

    def _decode_message(self, message: BoundMessage, frames: Frames, out: dict[Role, list[Series]]) -> None:
        whole = frames.length >= self._needs[message.name]
        if not whole.all():
            self.rejected[f"{message.name}: short frame"] += int((~whole).sum())
            frames = frames[whole]
        present = self._multiplexed(message, frames)
        source = frames.ident & 0xFF
        useful = np.zeros(len(frames), dtype=bool)
        for bound in message.signals:
            here = present[bound.signal.multiplexer_signal or ""]
            if bound.signal.multiplexer_signal:
                here = here & self._selected(message, bound.signal, frames)
            if message.by_pgn:
                here = here & (source == self._source_of(message, bound, frames[here]))
            if not here.any():
                continue
            useful |= here
            part = frames[here]
            value, counts = self._value(bound, part, message.by_pgn)
            for reason, count in counts.items():
                self.rejected[f"{_path(message, bound)}: {reason}"] += count
            out.setdefault(bound.role, []).append(Series(part.t, value))
        self.used += int(useful.sum())
        if message.by_pgn and not useful.all():
            known = any(_path(message, bound) in self.sources for bound in message.signals)
            reason = "other source address" if known else "no valid value"
            self.rejected[f"{message.name}: {reason}"] += int((~useful).sum())

    def _selected(self, message: BoundMessage, signal: Signal, frames: Frames) -> Mask:
        """In which frames the multiplexer of ``signal`` selects it."""
        parent = next(s for s in message.multiplexers if s.name == signal.multiplexer_signal)
        return np.isin(extract(frames.data, parent), np.array(signal.multiplexer_ids or [], dtype=np.uint64))

    def _multiplexed(self, message: BoundMessage, frames: Frames) -> dict[str, Mask]:
        """For each multiplexer of the message, in which frames it is itself present."""
        present = {"": np.ones(len(frames), dtype=bool)}
        waiting = list(message.multiplexers)
        while waiting:
            signal = next(s for s in waiting if (s.multiplexer_signal or "") in present)
            waiting.remove(signal)
            here = present[signal.multiplexer_signal or ""]
            if signal.multiplexer_signal:
                here = here & self._selected(message, signal, frames)
            present[signal.name] = here
        return present

    def _value(self, bound: BoundSignal, frames: Frames, special: bool) -> tuple[Floats, Counter[str]]:
        """SI values, NaN where the sender gave none, and how many for which reason."""
        signal = bound.signal
        raw = extract(frames.data, signal)
        value = _number(raw, signal)
        masks: dict[str, Mask] = {}
        if special:
            masks["not available"], masks["error"], masks["reserved value"] = classify(raw, signal.length)
        low, high = signal.minimum, signal.maximum
        valued = np.logical_not(np.any(list(masks.values()), axis=0)) if masks else np.ones(len(value), dtype=bool)
        if low is not None and high is not None and low < high:
            # Half a bit of room: ranges in DBC files are often written rounded.
            room = abs(float(signal.scale)) / 2
            masks["out of range"] = valued & ((value < float(low) - room) | (value > float(high) + room))
        masks["not a number"] = valued & ~np.isfinite(value)
        value = value * bound.conversion.scale + bound.conversion.offset
        if bound.tangent:
            value = np.tan(value)
        counts: Counter[str] = Counter()
        for reason, mask in masks.items():
            if mask.any():
                counts[reason] = int(mask.sum())
                value[mask] = np.nan
        return value, counts

    def _source_of(self, message: BoundMessage, bound: BoundSignal, frames: Frames) -> int:
        """The source address that speaks for a signal; -1 while nobody has sent a valid value."""
        path = _path(message, bound)
        if path not in self.sources and len(frames):
            valid = np.isfinite(self._value(bound, frames, True)[0])
            sources, counts = np.unique(frames.ident[valid] & 0xFF, return_counts=True)
            if len(sources):
                self.sources[path] = int(sources[np.argmax(counts)])
        return self.sources.get(path, -1)


def _path(message: BoundMessage, bound: BoundSignal) -> str:
    return f"{message.name}.{bound.signal.name}"


def _stack(packets: list[MultiPacket], width: int) -> Frames:
    """Reassembled messages in the form of frames, cut or zero-filled to the length the DBC says."""
    rows = [np.frombuffer(p.payload[:width].ljust(width, b"\0"), dtype=np.uint8) for p in packets]
    return Frames(
        np.array([p.t for p in packets], dtype=np.float64),
        np.array([EXTENDED | p.pgn << 8 | p.source for p in packets], dtype=np.uint32),
        np.array([min(len(p.payload), 255) for p in packets], dtype=np.uint8),
        np.array(rows, dtype=np.uint8).reshape(-1, width),
    )

"""Answers of more than 8 bytes to a tester, joined from CAN frames while listening (ISO 15765-2, normal addressing).

An answer is a single frame (``0L`` and up to 7 bytes), or a first frame (``1L LL`` and 6 bytes) with consecutive
frames. These are ``2N`` and up to 7 bytes, where N counts from 1 and restarts at 0 after 15. Flow control (``3x``) has
another identifier, or is ignored. Identifiers of 11 and of 29 bits are treated alike.
"""

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from estimator.can_io.binding import BoundMessage, last_byte
from estimator.can_io.frames import CLASSIC_BYTES, JOINED_BYTES, Frames
from estimator.signals import Mask

SINGLE, FIRST, CONSECUTIVE = 0, 1, 2  # upper half of the first byte of a frame
FIRST_BYTES = 6  # of the answer in a first frame
PACKET_BYTES = 7  # of the answer in a consecutive frame
N_CR = 1.0  # s to the next frame, after which a receiver gives up (ISO 15765-2, table 21)
NUMBERS = 16  # that consecutive frames are counted by

Places = NDArray[np.intp]


def is_segmented(message: BoundMessage) -> bool:
    """True if classic frames carry the message in segments: it exceeds 8 bytes and is not a parameter group."""
    if message.by_pgn or message.length <= CLASSIC_BYTES:
        return False
    return any(bound.multiplexers or last_byte(bound.signal) > CLASSIC_BYTES for bound in message.signals)


def keeps_length(message: BoundMessage) -> bool:
    """True if the database counts the low byte of an answer's length as its first byte, as in a single frame.

    The outermost multiplexer shows it: it is the service, of one byte, or the identifier behind it, of two bytes.
    """
    roots = [bound.multiplexers[-1] for bound in message.signals if bound.multiplexers]
    return any(root.start // 8 == (2 if root.length > 8 else 1) for root in roots)


class IsoTp:
    """Joins the answers of a message, with at most one unfinished answer for each identifier.

    An answer that lacks a frame is dropped whole; ``rejected`` counts why, under the name of the message.
    """

    def __init__(self, message: BoundMessage) -> None:
        self.rejected: Counter[str] = Counter()
        self._name, self._lead = message.name, int(keeps_length(message))
        need = max(last_byte(signal) for bound in message.signals for signal in (bound.signal, *bound.multiplexers))
        self._packets = max(-(-(need - self._lead - FIRST_BYTES) // PACKET_BYTES), 0)  # that hold what is wanted
        self._open: dict[int, Frames] = {}  # the frames of an answer under way, by identifier

    def feed(self, frames: Frames) -> Frames:
        """Return the answers that these frames complete, each at the time of its last frame; CAN FD frames pass."""
        is_long = frames.length > CLASSIC_BYTES
        parts = [frames[is_long]] if is_long.any() else []
        segments = frames[~is_long] if is_long.any() else frames
        for ident in np.unique(segments.ident).tolist():
            answer_frames = segments[segments.ident == ident]
            unfinished = self._open.pop(ident, None)
            parts.append(
                self._join(answer_frames if unfinished is None else Frames.concatenate([unfinished, answer_frames]))
            )
        joined = Frames.concatenate(parts)
        return joined[np.argsort(joined.t, kind="stable")] if len(parts) > 1 else joined

    def _join(self, frames: Frames) -> Frames:
        """Answers in the frames of one identifier; an unfinished answer at their end is kept for the next batch."""
        kind = frames.data[:, 0] >> 4
        frames = frames[(kind <= CONSECUTIVE) & (frames.length > 0)]
        kind = frames.data[:, 0] >> 4
        first = np.flatnonzero(kind != CONSECUTIVE)
        if not len(first):  # the log began in the middle of an answer
            return frames[:0]
        is_single = kind[first] == SINGLE
        size = self._sizes(frames, first, is_single)
        packets = np.where(is_single, 0, -(-(size - FIRST_BYTES) // PACKET_BYTES))
        there = np.diff(np.append(first, len(frames))) - 1  # consecutive frames behind each
        is_sound = _are_in_order(frames, first, size, packets) & (is_single | (size > 0))
        is_whole = is_sound & (there >= packets)
        unfinished = is_sound & ~is_whole
        if unfinished[-1]:
            self._open[int(frames.ident[0])] = frames[first[-1] :]
        self._count("answer broken off", unfinished[:-1])
        self._count("consecutive frame lost or late", ~is_sound & (is_single | (size > 0)))
        return self._payloads(frames, first[is_whole], size[is_whole], packets[is_whole], is_single[is_whole])

    def _sizes(self, frames: Frames, first: Places, is_single: Mask) -> Places:
        """Sizes (k,) [bytes] of the answers that begin at ``first`` (k,); 0 if they cannot be joined."""
        head = frames.data[first].astype(np.intp)
        length = frames.length[first]
        short = head[:, 0] & 0x0F
        short = np.where(short < length, short, 0)  # beyond the frame: counted as a short one by who reads it
        long = (head[:, 0] & 0x0F) << 8 | head[:, 1]
        is_first = ~is_single
        # A length of 0 is the escape to 32 bits: up to 4 GB.
        self._count(f"answer of more than {JOINED_BYTES} bytes", is_first & (long == 0))
        possible = (long >= CLASSIC_BYTES) & (length == CLASSIC_BYTES)
        self._count("impossible first frame", is_first & (long > 0) & ~possible)
        return np.where(is_single, short, np.where(possible, long, 0))

    def _count(self, reason: str, mask: Mask) -> None:
        if number := int(np.count_nonzero(mask)):
            self.rejected[f"{self._name}: {reason}"] += number

    def _payloads(self, frames: Frames, first: Places, size: Places, packets: Places, is_single: Mask) -> Frames:
        """Payloads of whole answers, cut or zero-filled to the required bytes."""
        lead = self._lead
        width = -(-(lead + FIRST_BYTES + PACKET_BYTES * self._packets + 1) // CLASSIC_BYTES) * CLASSIC_BYTES
        data = np.zeros((len(first), width), np.uint8)
        head = frames.data[first]
        data[:, : lead + FIRST_BYTES] = head[:, 2 - lead : CLASSIC_BYTES]
        for number in range(1, self._packets + 1):
            begin = lead + FIRST_BYTES + PACKET_BYTES * (number - 1)
            following = frames.data[first + np.minimum(number, packets), 1:CLASSIC_BYTES]
            data[:, begin : begin + PACKET_BYTES] = following
        data[is_single, : lead + PACKET_BYTES] = head[is_single, 1 - lead : CLASSIC_BYTES]
        length = size + np.where(size > 0, lead, 0)
        data[np.arange(width) >= length[:, None]] = 0
        last = first + packets
        return Frames(frames.t[last], frames.ident[last], length.astype(np.uint16), data)


def _are_in_order(frames: Frames, first: Places, size: Places, packets: Places) -> Mask:
    """Flag (k,) the first frames ``first`` (k,) whose consecutive frames, as far as they have come, are in order.

    Only the ``packets`` (k,) frames of an answer of ``size`` (k,) bytes are checked.
    """
    owner = np.searchsorted(first, np.arange(len(frames)), side="right") - 1  # -1: before the first answer
    number = np.arange(len(frames)) - first[owner]
    step = np.diff(frames.t, prepend=frames.t[:1])
    left = size[owner] - FIRST_BYTES - PACKET_BYTES * (number - 1)
    is_wrong = (frames.data[:, 0] & 0x0F) != number % NUMBERS
    is_wrong |= (step < 0) | (step > N_CR) | (frames.length <= np.minimum(left, PACKET_BYTES))
    is_wrong &= (owner >= 0) & (number >= 1) & (number <= packets[owner])
    sound = np.ones(len(first), dtype=bool)
    sound[owner[is_wrong]] = False
    return sound

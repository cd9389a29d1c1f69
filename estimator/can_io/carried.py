"""Readings of the bound signals in the frames of a message, before a sender is chosen."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.can_io.binding import BoundMessage, BoundSignal
from estimator.can_io.frames import Frames
from estimator.can_io.heard import NO_ADDRESS, Heard
from estimator.can_io.signal_values import present, values
from estimator.signals import Floats, Mask


def path_of(message: BoundMessage, bound: BoundSignal) -> str:
    """Path MESSAGE.signal of a bound signal."""
    return f"{message.name}.{bound.signal.name}"


@dataclass(frozen=True, slots=True, kw_only=True)
class CarriedSignal:
    """Readings ``heard`` of one signal, and indices ``frames`` (n,) of the frames of its message that carry it.

    ``frames`` is None if all carry it. ``masks`` (n,) flag, by reason, the readings without a value.
    """

    bound: BoundSignal
    path: str
    frames: NDArray[np.intp] | None
    heard: Heard
    masks: dict[str, Mask]

    def of_message(self, mask: Mask, count: int) -> Mask:
        """Expand a mask of the readings (n,) to all frames of the message (count,)."""
        if self.frames is None:
            return mask
        wide = np.zeros(count, dtype=bool)
        wide[self.frames] = mask
        return wide

    def within(self, part: slice, ends: Floats) -> "CarriedSignal":
        """Restrict to the frames ``part`` of the message, in blocks that end at ``ends`` (k,) [s]."""
        frames = self.frames
        if frames is not None:
            low, high = np.searchsorted(frames, [part.start, part.stop]).tolist()
            frames, part = frames[low:high] - part.start, slice(low, high)
        masks = {reason: mask[part] for reason, mask in self.masks.items()}
        return CarriedSignal(
            bound=self.bound, path=self.path, frames=frames, heard=self.heard.within(part, ends), masks=masks
        )


@dataclass(frozen=True, slots=True)
class CarriedMessage:
    """Signals of one message, and the times ``t`` (n,) [s] of its frames."""

    message: BoundMessage
    t: Floats
    signals: tuple[CarriedSignal, ...]

    @classmethod
    def of(cls, message: BoundMessage, frames: Frames, ends: Floats) -> "CarriedMessage":
        """Extract the signals in frames of a message, in blocks that end at ``ends`` (k,) [s]."""
        source = frames.ident.astype(np.uint8) if message.names_sender else np.full(len(frames), NO_ADDRESS, np.uint8)
        signals = tuple(_signal(message, bound, frames, source, ends) for bound in message.signals)
        return cls(message, frames.t, signals)

    def halves(self, ends: Floats) -> "tuple[CarriedMessage, CarriedMessage]":
        """Split into the first and the second half of the blocks, which end at ``ends`` (k,) [s]."""
        half = len(ends) // 2
        cut, last = int(np.searchsorted(self.t, ends[half - 1])), len(self.t)
        return self._within(slice(0, cut), ends[:half]), self._within(slice(cut, last), ends[half:])

    def _within(self, part: slice, ends: Floats) -> "CarriedMessage":
        return CarriedMessage(self.message, self.t[part], tuple(signal.within(part, ends) for signal in self.signals))


def _signal(
    message: BoundMessage, bound: BoundSignal, frames: Frames, source: NDArray[np.uint8], ends: Floats
) -> CarriedSignal:
    carrying = None
    if bound.multiplexers and len(frames):
        carrying = np.flatnonzero(present(bound, frames))
        frames, source = frames[carrying], source[carrying]
    value, masks = values(message, bound, frames) if len(frames) else (np.empty(0), {})
    heard = Heard(frames.t, source, value, ends)
    return CarriedSignal(bound=bound, path=path_of(message, bound), frames=carrying, heard=heard, masks=masks)

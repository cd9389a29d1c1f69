"""Merging of several streams of frames in order of time."""

from collections.abc import Iterator

import numpy as np

from estimator.can_io.frames import Frames
from estimator.signals import Floats


class _Stream:
    """Stream with one batch in memory; ``keys`` (n,) [s] are the running maximum of its times."""

    def __init__(self, batches: Iterator[Frames]) -> None:
        self.batches = batches
        self._latest = -np.inf
        self.frames = Frames.concatenate([])
        self.keys: Floats = np.empty(0)
        self.is_at_end = False

    def fill(self) -> None:
        """Read a batch, if there is another one and none is held."""
        while not len(self.frames) and not self.is_at_end:
            batch = next(self.batches, None)
            if batch is None:
                self.is_at_end = True
            elif len(batch):
                self.frames = batch
                self.keys = np.fmax.accumulate(np.concatenate(([self._latest], batch.t)))[1:]
                self._latest = float(self.keys[-1])

    def take(self, until: float, is_first: bool) -> tuple[Frames, Floats]:
        """Take the frames before a time, or up to it if it is this stream's turn, with their keys."""
        count = int(np.searchsorted(self.keys, until, "right" if is_first else "left"))
        taken = self.frames[:count], self.keys[:count]
        self.frames, self.keys = self.frames[count:], self.keys[count:]
        return taken


def merged(streams: list[Iterator[Frames]]) -> Iterator[Frames]:
    """Yield frames of all streams: always the earliest of the next frames, at equal times that of the first stream.

    Frames of a stream keep their order. Each stream holds one batch.
    """
    held = [_Stream(stream) for stream in streams]
    while True:
        for stream in held:
            stream.fill()
        held = [stream for stream in held if len(stream.frames)]
        if len(held) < 2:
            break
        until = min(float(stream.keys[-1]) for stream in held)
        turn = next(i for i, stream in enumerate(held) if stream.keys[-1] == until)
        taken = [stream.take(until, i <= turn) for i, stream in enumerate(held)]
        keys = np.concatenate([stream_keys for _, stream_keys in taken])
        yield Frames.concatenate([frames for frames, _ in taken])[np.argsort(keys, kind="stable")]
    for stream in held:
        yield stream.frames
        yield from stream.batches

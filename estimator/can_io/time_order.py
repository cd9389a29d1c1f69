"""Ordering of frames by time.

Loggers with several channels, and gateways that record a transport message as a whole, write frames up to a second
after later ones. Such frames are put in order. A larger step back means another recording, or a clock that was set.
"""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from estimator.can_io.frames import Frames
from estimator.signals import Floats

MAX_DELAY = 1.0  # s behind the latest time so far by which a frame may come
MAX_TIME = 1e11  # s, the year 5138; a larger time is none
MAX_HELD = 1 << 20  # frames; no bus carries as many within MAX_DELAY
FINER_UNITS = {"milliseconds": 1_000, "microseconds": 1_000_000, "nanoseconds": 1_000_000_000}  # in a second
NO_TIME = "time that is no number from 0 to 1e11 s"


def is_time(t: float) -> bool:
    """True if ``t`` [s] can be the time of a frame."""
    return 0 <= t <= MAX_TIME


def finer_unit(step: float, most: float, t: float = 0.0, least: float = 0.0) -> str | None:
    """The unit in which a ``step`` is from ``least`` to ``most`` [s], and ``t`` can be a time, if seconds are too long.

    None if there is no such unit.
    """
    fitting = (unit for unit, n in FINER_UNITS.items() if least <= step / n <= most and t / n <= MAX_TIME)
    return next(fitting, None)


def divided(unit: str) -> str:
    """Advice for a log whose times may be in a finer unit."""
    return f"if the times of the log are {unit}, divide them by {FINER_UNITS[unit]:,}"


def latest_before(t: Floats, latest: float) -> Floats:
    """Running maximum (n + 1,) [s] before each of the times ``t`` (n,), and after all; ``latest`` is that so far."""
    return np.maximum.accumulate(np.concatenate(([latest], t)))


class TimeOrder:
    """Sorts frames that come at most MAX_DELAY late; frames of equal time stay in order of arrival.

    The result does not depend on how the frames are cut into batches.

    Attributes
    ----------
    reordered : int
        Frames that came after one with a later time.
    steps_back : int
        Frames that came more than MAX_DELAY late, each the first of another recording.
    refused : collections.Counter[str]
        Frames without a usable time.
    """

    def __init__(self) -> None:
        self.reordered = 0
        self.steps_back = 0
        self.refused: Counter[str] = Counter()
        self._start()

    def _start(self) -> None:
        self._held = Frames.concatenate([])
        self._latest = -np.inf  # s

    def feed(self, frames: Frames) -> Iterator[Frames]:
        """Take frames in order of arrival; yields those that none can precede, by recording."""
        timed = (frames.t >= 0) & (frames.t <= MAX_TIME)
        if not timed.all():
            self.refused[NO_TIME] += int(np.count_nonzero(~timed))
            frames = frames[timed]
        while len(frames):
            latest = latest_before(frames.t, self._latest)
            steps = np.flatnonzero(frames.t < latest[:-1] - MAX_DELAY)
            end = int(steps[0]) if len(steps) else len(frames)
            self.reordered += int(np.count_nonzero(frames.t[:end] < latest[:end]))
            self._latest = float(latest[end])
            self._hold(frames[:end])
            if end < len(frames):
                self.steps_back += 1
                yield self.finish()
            else:
                yield self._release()
            frames = frames[end:]

    def finish(self) -> Frames:
        """Return the frames still held, at the end of the traffic or of a recording."""
        held = self._held
        self._start()
        return held

    def _hold(self, frames: Frames) -> None:
        joined = Frames.concatenate([self._held, frames]) if len(self._held) else frames
        if np.any(joined.t[1:] < joined.t[:-1]):
            joined = joined[np.argsort(joined.t, kind="stable")]
        self._held = joined

    def _release(self) -> Frames:
        """Return the frames that no later frame, at most MAX_DELAY late, can precede."""
        due = int(np.searchsorted(self._held.t, self._latest - MAX_DELAY, side="right"))
        due = max(due, len(self._held) - MAX_HELD)
        released, self._held = self._held[:due], self._held[due:]
        return released

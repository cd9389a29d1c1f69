"""Check that the times of a log can be used.

A log is read in the order of the file. Frames up to MAX_DELAY late are sorted later; a larger step back begins another
recording, as in joined logs. Many such steps mean that the times are not those of one clock. More frames per time than
ten buses carry mean that the clock stands still: the blocks in which frames are judged would exhaust the memory. Frames
of which most come minutes apart have times in a finer unit than seconds: each would be a block of its own.
"""

from pathlib import Path

import numpy as np

from estimator.can_io.frames import Frames
from estimator.can_io.time_order import MAX_DELAY, MAX_TIME, divided, finer_unit, latest_before
from estimator.errors import LogError
from estimator.signals import Floats

MAX_STEPS_BACK = 100  # recordings in one log
SPAN, MAX_IN_SPAN = 5.0, 1 << 20  # s, and frames that are too many for it: ten full buses of 1 Mbit/s carry as many
APART = 100.0  # s from a frame to the next: no bus sends more than half of 1,000 frames so

MIN_FRAMES = 100  # in which rising times can be told
MIN_RISING = 0.05  # share of the frames that come no earlier than all before; differences in time: 0.01 of 1,000


class TimeCheck:
    """Check of the times in one pass over a log."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._latest = -np.inf  # s
        self._seen = 0
        self._steps_back = 0
        self._first_step = ""
        self._span_start = -np.inf  # s
        self._in_span = 0  # frames since then
        self._apart = 0  # frames that come more than APART after the one before
        self._rising = 0  # frames that came no earlier than all before

    def check(self, frames: Frames) -> None:
        """Check the next frames of the log.

        Raises
        ------
        LogError
            A time is invalid, steps back by more than MAX_DELAY for the MAX_STEPS_BACK-th time, stands still, or is
            not in seconds.
        """
        t = frames.t
        self._count(float(t[-1]), len(t))
        self._check_range(t)
        self._check_unit(t)
        if self._latest <= t[0] and (t[1:] >= t[:-1]).all():  # the rule
            self._latest, self._seen, self._rising = float(t[-1]), self._seen + len(frames), self._rising + len(frames)
            return
        first = 0
        while first < len(frames):
            t = frames.t[first:]
            latest = latest_before(t, self._latest)
            steps = np.flatnonzero(t < latest[:-1] - MAX_DELAY)
            end = int(steps[0]) if len(steps) else len(t)
            self._rising += int(np.count_nonzero(t[:end] >= latest[:end]))
            if not len(steps):
                self._latest = float(latest[-1])
                break
            i = end
            self._step_back(self._seen + first + i + 1, float(latest[i]), float(t[i]))
            self._latest = -np.inf
            first += i
        self._seen += len(frames)

    def finish(self) -> None:
        """Check the times of the whole log.

        Raises
        ------
        LogError
            The times do not rise.
        """
        if self._seen >= MIN_FRAMES and self._rising < MIN_RISING * self._seen:
            raise LogError(
                f"{self._path}: times do not rise: {self._seen - self._rising:,} of {self._seen:,} frames come earlier "
                "than one before; if they are differences, as of candump -td, record with -ta"
            )

    def _count(self, t: float, count: int) -> None:
        """Count frames up to time ``t`` [s]."""
        if not 0.0 <= t - self._span_start <= SPAN:
            self._span_start, self._in_span = t, 0
        self._in_span += count
        if self._in_span > MAX_IN_SPAN:
            raise LogError(
                f"{self._path}: {self._in_span:,} frames up to frame {self._seen + count:,} within {SPAN:g} s, "
                "which no bus carries; give a log whose times are right"
            )

    def _check_range(self, t: Floats) -> None:
        """Refuse times (n,) that are none; if the first one is too large, all are in a finer unit than seconds."""
        if t.min() >= 0 and t.max() <= MAX_TIME:
            return
        i = int(np.flatnonzero(~((t >= 0) & (t <= MAX_TIME)))[0])
        unit = finer_unit(0.0, 0.0, float(t[0])) if self._seen + i == 0 else None
        raise LogError(
            f"{self._path}: frame {self._seen + i + 1} has the time {t[i]:g} s; times must be numbers from 0 to "
            f"{MAX_TIME:g}: {divided(unit) if unit else 'remove or correct that frame'}"
        )

    def _check_unit(self, t: Floats) -> None:
        """Check times (n,) [s] for a finer unit than seconds."""
        with np.errstate(invalid="ignore"):
            self._apart += int(np.count_nonzero(np.diff(t) > APART))
        seen = self._seen + len(t)
        if seen >= 10 * MIN_FRAMES and 2 * self._apart > seen:
            raise LogError(
                f"{self._path}: {self._apart:,} of {seen:,} frames come more than {APART:g} s after the one before, as "
                "on no bus; if the times are microseconds, divide them by 1,000,000"
            )

    def _step_back(self, frame: int, previous: float, t: float) -> None:
        self._steps_back += 1
        self._first_step = self._first_step or f"first at frame {frame}, from {previous:.6f} s to {t:.6f} s"
        if self._steps_back == MAX_STEPS_BACK:
            raise LogError(
                f"{self._path}: time steps back {MAX_STEPS_BACK} times by more than {MAX_DELAY:g} s, "
                f"{self._first_step}; give the recordings in it as logs of their own, or one --channel"
            )

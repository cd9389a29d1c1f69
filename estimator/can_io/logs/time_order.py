"""Whether the timestamps of a log run forward.

A reader never reorders. Frames of two channels may arrive a little out of step; a larger step back means that logs
were joined or a clock was set, and differences of time would then be wrong.
"""

from pathlib import Path

import numpy as np

from estimator.can_io.frames import Frames
from estimator.errors import LogError

MAX_STEP_BACK = 0.1  # s, behind the latest time seen so far


class TimeOrder:
    """The time check of one pass over a log.

    ``reordered`` counts the frames that lie behind an earlier one by no more than ``MAX_STEP_BACK``.
    """

    def __init__(self, path: Path, max_step_back: float = MAX_STEP_BACK) -> None:
        self._path = path
        self._max_step_back = max_step_back
        self._latest = 0.0  # s; no timestamp may be negative, so this is before all of them
        self._seen = 0
        self.reordered = 0

    def check(self, frames: Frames) -> None:
        """Take note of the next frames of the log.

        Raises
        ------
        LogError
            Where a time is negative or not a number, or steps back too far.
        """
        t = frames.t
        bad = np.flatnonzero(~(np.isfinite(t) & (t >= 0)))
        if len(bad):
            raise LogError(
                f"{self._path}: frame {self._seen + int(bad[0]) + 1} has the time {t[bad[0]]:g} s; "
                "times must be numbers from 0 on: remove or correct that frame"
            )
        latest = np.maximum.accumulate(np.concatenate(([self._latest], t)))
        behind = latest[:-1] - t
        steps = np.flatnonzero(behind > self._max_step_back)
        if len(steps):
            i = int(steps[0])
            raise LogError(
                f"{self._path}: time steps back at frame {self._seen + i + 1}, from {latest[i]:.6f} s to {t[i]:.6f} s; "
                "split the log there, or sort it by time if recordings were merged"
            )
        self.reordered += int(np.count_nonzero(behind > 0))
        self._latest = float(latest[-1])
        self._seen += len(t)

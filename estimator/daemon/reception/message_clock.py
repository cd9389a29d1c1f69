"""Message times without steps: the stamps of a bus follow a wall clock, which GNSS or NTP may set at any moment.

The wall clock is compared with a monotonic clock. A stamp may be late, by the time that its frame lay in a buffer, but
never early, and stamps ascend. A contradiction of more than `MIN_STEP` is a step of the wall clock, which is subtracted
from the stamps. Late stamps alone mean a step only if they are late by `MIN_LATENESS` for `MAX_LATE_DURATION`.
"""

import numpy as np

from estimator.signals import Floats, Mask

MIN_LATENESS = 1.0  # s by which stamps must be late one after another to mean a clock that was set back
MIN_STEP = 0.1  # s by which stamps must be early, or step back, to mean a clock that was set
MAX_LATE_DURATION = 5.0  # s for which frames may be late one after another; beyond, the clock was set back
MAX_STAMP = 1e11  # s; a stamp beyond is none
DRIFT_RATE = 1e-3  # s per second by which the clocks' difference is followed: they drift by parts per million
MAX_DRIFT = MIN_STEP / 2  # s at once: frames from before a suspension are late by all of it, and no drift
SETTLING = 2.0  # s after the first frame, in which stamps that are early mean that the first came late


class MessageClock:
    """Corrects the stamps of one bus; ``steps`` counts how often its clock was set.

    Parameters
    ----------
    ahead
        How far wall time is ahead of monotonic time at the start [s]; it dates messages that carry no time.
    """

    def __init__(self, ahead: float) -> None:
        self.steps = 0
        self._ahead = ahead
        self._began: float | None = None  # [s] monotonic time of the first stamp
        self._followed = 0.0  # [s] monotonic time up to which drift was followed
        self._correction = 0.0  # [s] taken off the stamps
        self._newest_stamp = -np.inf
        self._last = -np.inf  # message time [s] handed out
        self._late_since: float | None = None

    def at(self, now: float) -> float:
        """Message time [s] of the monotonic instant ``now`` [s]; never below a time handed out."""
        return max(now + self._ahead, self._last)

    def correct(self, stamps: Floats, now: float) -> Floats:
        """Message times (n,) [s], not descending, of frames stamped ``stamps`` (n,) [s] and drained at ``now`` [s]."""
        if not len(stamps):
            return stamps
        dated = (stamps > 0) & (stamps < MAX_STAMP)
        t = np.where(dated, stamps - self._correction, now + self._ahead)
        if dated.any():
            self._follow(stamps, dated, t, now)
        t = np.maximum.accumulate(np.maximum(t, self._last))
        t = np.minimum(t, max(now + self._ahead + MIN_LATENESS, self._last))
        self._last = float(t[-1])
        return t

    def _follow(self, stamps: Floats, dated: Mask, t: Floats, now: float) -> None:
        """Take a step of the clock out of ``t``, in place."""
        known = np.flatnonzero(dated)
        seen = stamps[known]
        if self._began is None:
            self._began = self._followed = now
            self._ahead = float(seen[-1]) - now
            t[known] = seen
        disagreement = float(t[known[-1]]) - (now + self._ahead)
        before = np.concatenate([[self._newest_stamp if np.isfinite(self._newest_stamp) else seen[0]], seen[:-1]])
        self._newest_stamp = float(seen[-1])
        if self._is_step(disagreement, seen - before, now):
            self.steps += 1
            self._late_since = None
            self._correction += disagreement
            first = int(np.argmin(np.abs(seen - before - disagreement)))
            t[known[first:]] -= disagreement
        elif disagreement > MIN_STEP:
            self._ahead += disagreement  # all stamps before were late
        else:
            most = min(DRIFT_RATE * (now - self._followed), MAX_DRIFT)
            self._ahead += min(max(disagreement, -most), most)
        self._followed = now

    def _is_step(self, disagreement: float, gaps: Floats, now: float) -> bool:
        """Whether the clock was set, given the time [s] by which the newest stamp is early and the ``gaps`` (n,)."""
        if disagreement > MIN_STEP:
            self._late_since = None
            settling = self._began is not None and now - self._began < SETTLING and disagreement < MIN_LATENESS
            return not settling and bool(gaps.max() > disagreement - MIN_STEP / 2)
        if disagreement > -MIN_STEP:
            self._late_since = None
            return False
        if gaps.min() < -MIN_STEP:
            return True
        if disagreement > -MIN_LATENESS:
            self._late_since = None
            return False
        self._late_since = now if self._late_since is None else self._late_since
        return now - self._late_since > MAX_LATE_DURATION

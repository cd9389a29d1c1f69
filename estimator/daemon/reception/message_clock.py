"""Message times that never step: the stamps of a bus follow a wall clock, which GNSS or NTP may set at any moment.

The wall clock is held against a monotonic one. A stamp may come late, by as long as its frame lay in a buffer, but
never early, and of two frames the later has the later stamp. What contradicts this by more than `SMALL_STEP` was a step
of the wall clock: it is taken out again, so that time passes for the estimator as it does on the road. Lateness alone
contradicts nothing until it exceeds `STEP` for `LATENESS`.
"""

import numpy as np

from estimator.signals import Floats, Mask

STEP = 1.0  # s by which stamps must be late one after another to mean a clock that was set back
SMALL_STEP = 0.1  # s by which stamps must be early, or step back, to mean a clock that was set
LATENESS = 5.0  # s for which frames may be late one after another; beyond, the clock was set back
LATEST = 1e11  # s; a stamp beyond is none
TRACKING = 1e-3  # s per second by which the clocks' difference is followed: they drift by parts per million
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
        dated = (stamps > 0) & (stamps < LATEST)
        t = np.where(dated, stamps - self._correction, now + self._ahead)
        if dated.any():
            self._follow(stamps, dated, t, now)
        t = np.maximum.accumulate(np.maximum(t, self._last))
        t = np.minimum(t, max(now + self._ahead + STEP, self._last))
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
        elif disagreement > SMALL_STEP:
            self._ahead += disagreement  # all stamps before were late
        else:
            most = TRACKING * (now - self._followed)
            self._ahead += min(max(disagreement, -most), most)
        self._followed = now

    def _is_step(self, disagreement: float, gaps: Floats, now: float) -> bool:
        """Whether the clock was set, given the time [s] by which the newest stamp is early and the ``gaps`` (n,)."""
        if disagreement > SMALL_STEP:
            self._late_since = None
            settling = self._began is not None and now - self._began < SETTLING and disagreement < STEP
            return not settling and bool(gaps.max() > disagreement - SMALL_STEP / 2)
        if disagreement > -SMALL_STEP:
            self._late_since = None
            return False
        if gaps.min() < -SMALL_STEP:
            return True
        if disagreement > -STEP:
            self._late_since = None
            return False
        self._late_since = now if self._late_since is None else self._late_since
        return now - self._late_since > LATENESS

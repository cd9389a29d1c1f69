"""Duration for which a contested signal is not used."""

from typing import Any

import numpy as np

from estimator.can_io.contradiction import Contradiction
from estimator.checkpoint.validation import State, read
from estimator.errors import StateError

MAX_CONTEST_GROWTH = 20  # times the shortest, to which contests grow that follow each other
RECURRENCE = 10  # times its duration, within which a contest after another counts as the same again


class Contest:
    """Contradiction in a signal, and the time until it counts as over; ``reason`` is empty while there is none.

    It lasts for ``shortest`` [s] after the last contradiction. One that recurs soon lasts twice as long, because a
    wrong reading contradicts the others only while its quantity changes.
    """

    def __init__(self, shortest: float) -> None:
        self.reason = ""
        self.before: float | None = None  # address or value in use when it began
        self._shortest = self._duration = shortest
        self._until = -np.inf  # [s]

    def extend(self, reason: str, end: float, believed: float | None) -> None:
        """Begin or prolong the contest by a contradiction in the block that ended at ``end`` [s]."""
        if not self.reason:
            self.before = believed
            recurs = end - self._until < RECURRENCE * self._duration
            longer = min(2 * self._duration, MAX_CONTEST_GROWTH * self._shortest)
            self._duration = longer if recurs else self._shortest
        self.reason, self._until = reason, end + self._duration

    def is_over(self, end: float) -> bool:
        """True if the last contradiction is long enough ago at time ``end`` [s]; False without a contest."""
        return bool(self.reason) and end >= self._until

    def settle(self) -> None:
        """End the contest."""
        self.reason, self.before = "", None

    def state(self) -> dict[str, Any]:
        """State for `restore`."""
        until = self._until if np.isfinite(self._until) else None
        return {"reason": self.reason, "before": self.before, "until": until, "duration": self._duration}

    def restore(self, state: State) -> None:
        """Take the state of another contest.

        Raises
        ------
        StateError
            The state is not that of a contest.
        """
        self.reason, self.before = read(state, "reason", str), read(state, "before", float | None)
        if self.reason not in ("", *Contradiction):
            raise StateError(f"reason: {self.reason!r} is none")
        until = read(state, "until", float | None)
        self._until = -np.inf if until is None else until
        longest = MAX_CONTEST_GROWTH * self._shortest
        self._duration = min(max(read(state, "duration", float), self._shortest), longest)

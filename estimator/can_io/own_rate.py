"""Rate of a sender: readings above its usual rate mean that another node sends under its address."""

from copy import copy
from math import inf
from statistics import median

import numpy as np

from estimator.can_io.contradiction import block_sums
from estimator.can_io.heard import Heard

MAX_RATE_RATIO = 1.5  # times its own rate, at which more than one node sends under an address
OWN_RATE_BLOCKS = 12  # newest blocks without a contest, 1 min, whose median is a sender's own rate
MIN_RATE_BLOCKS = 3  # of them, before that rate counts as known
MIN_READINGS_FOR_RATE = 6  # readings in a block for a rate
NEW_RATE_S = 600.0  # s after which a rate that contradicts nothing else counts as the sender's own
MIN_PERIOD_S = 0.01  # shortest period of a J1939 parameter group
SLOW_GROUP_HZ = 60.0  # that a group may always reach: EEC3, meant for 4 Hz, is sent with 50 by some
MAX_NOMINAL_RATES = 4.0  # times the rate of the database that a group may reach, up to the shortest period
JITTER = 1.2  # times the rate of the shortest period


def fastest(cycle: float | None) -> float:
    """Highest rate [1/s] of a J1939 group at one address, given its cycle time [s] in the database."""
    most = JITTER / MIN_PERIOD_S
    return most if not cycle else min(most, max(SLOW_GROUP_HZ, MAX_NOMINAL_RATES / cycle))


class OwnRate:
    """Usual rate of a sender, learnt from blocks without a contradiction.

    ``highest`` [1/s] is the limit for any sender of the group. ``follows_value``: the rate may rise with the value, as
    that of EEC1 with the engine speed (J1939-71).
    """

    def __init__(self, highest: float, follows_value: bool) -> None:
        self._highest, self._follows_value = highest, follows_value
        self.forget()

    def forget(self) -> None:
        """Discard the learnt rate."""
        self._known: tuple[tuple[float, float], ...] = ()  # newest [1/s], and over the value
        self._since: float | None = None  # when the rate began to be exceeded [s]

    def doubt(self, end: float) -> None:
        """Note a contradiction at ``end`` [s]; an exceeded rate must last from then on to count as the new one."""
        self._since = None if self._since is None else end

    def copy(self) -> "OwnRate":
        """Return an independent copy."""
        return copy(self)

    def exceeding(self, readings: Heard, step: float) -> list[bool]:
        """Flag the blocks with readings that come too fast; a change of rate at rest is ignored."""
        bounds = readings.bounds
        filled = np.flatnonzero(np.diff(bounds))
        first, last = bounds[filled], bounds[filled + 1] - 1
        sizes = block_sums(np.abs(readings.value), np.append(first, len(readings.t))) / (last - first + 1)
        spans = readings.t[last] - readings.t[first]
        blocks = zip(
            (last - first).tolist(), spans.tolist(), sizes.tolist(), readings.ends[filled].tolist(), strict=True
        )
        return [self._is_exceeded(periods, span, size, end, step) for periods, span, size, end in blocks]

    def _is_exceeded(self, periods: int, span: float, size: float, end: float, step: float) -> bool:
        if periods + 1 < MIN_READINGS_FOR_RATE or span <= 0:
            return False
        rate = periods / span
        if rate > self._highest:
            return True
        return size > step and self._is_new((rate, rate / size), end)

    def _is_new(self, now: tuple[float, float], end: float) -> bool:
        usual = (inf, inf) if len(self._known) < MIN_RATE_BLOCKS else tuple(map(median, zip(*self._known, strict=True)))
        if now[0] <= MAX_RATE_RATIO * usual[0] or (self._follows_value and now[1] <= MAX_RATE_RATIO * usual[1]):
            self._since = None
            self._known = (*self._known, now)[-OWN_RATE_BLOCKS:]
            return False
        self._since = end if self._since is None else self._since
        if end - self._since >= NEW_RATE_S:
            self.forget()
        return bool(self._known)

"""Readings of one signal from all its senders, in one or several blocks of traffic."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.signals import Floats, Mask

NO_ADDRESS = 0  # of messages that are matched by their whole id


@dataclass(frozen=True, slots=True)
class Heard:
    """Readings of one signal from all addresses, in blocks that end at ``ends`` (k,) [s].

    ``t`` [s], ``source`` (address) and ``value`` [SI], NaN where not valid: all (n,), in order of arrival.
    """

    t: Floats
    source: NDArray[np.uint8]
    value: Floats
    ends: Floats

    def of(self, chosen: Mask) -> "Heard":
        """Readings that the mask ``chosen`` (n,) selects."""
        return Heard(self.t[chosen], self.source[chosen], self.value[chosen], self.ends)

    def within(self, part: slice, ends: Floats) -> "Heard":
        """Slice ``part`` of the readings, which belongs to the blocks that end at ``ends`` (j,) [s]."""
        return Heard(self.t[part], self.source[part], self.value[part], ends)

    @property
    def end(self) -> float:
        """Time at which the last block ends [s]."""
        return float(self.ends[-1])

    @property
    def bounds(self) -> NDArray[np.intp]:
        """Indices (k + 1,) of the readings at the bounds of blocks."""
        if len(self.ends) == 1:
            return np.array([0, len(self.t)])
        return np.concatenate([[0], np.searchsorted(self.t, self.ends[:-1]), [len(self.t)]])

    @property
    def valid(self) -> "Heard":
        """Readings with a value."""
        finite = np.isfinite(self.value)
        return self if finite.all() else self.of(finite)

    def by_source(self) -> "dict[int, Heard]":
        """Readings by address, the most frequent first; of equally frequent ones the lowest first."""
        if len(self.t) and (self.source == self.source[0]).all():
            return {int(self.source[0]): self}
        counts = np.bincount(self.source)
        addresses = sorted(np.flatnonzero(counts).tolist(), key=lambda address: -counts[address])
        return {address: self.of(self.source == address) for address in addresses}

"""What was heard of one signal, from all its senders, in one or several blocks of traffic."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.signals import Floats, Mask

NO_ADDRESS = 0  # of messages that are matched by their whole id


@dataclass(frozen=True, slots=True)
class Heard:
    """What all addresses sent of one signal in blocks that end at ``ends`` (k,) [s].

    ``t`` [s], ``source`` (address) and ``value`` [SI], NaN where not valid: all (n,), in order of arrival.
    """

    t: Floats
    source: NDArray[np.uint8]
    value: Floats
    ends: Floats

    def of(self, chosen: Mask) -> "Heard":
        """The readings that ``chosen`` (n,) selects."""
        return Heard(self.t[chosen], self.source[chosen], self.value[chosen], self.ends)

    def within(self, part: slice, ends: Floats) -> "Heard":
        """The ``part`` of the readings that is of the blocks that end at ``ends`` [s]."""
        return Heard(self.t[part], self.source[part], self.value[part], ends)

    @property
    def end(self) -> float:
        """When the last block ends [s]."""
        return float(self.ends[-1])

    @property
    def bounds(self) -> NDArray[np.intp]:
        """Places (k + 1,) between which the readings of each block lie."""
        if len(self.ends) == 1:
            return np.array([0, len(self.t)])
        return np.concatenate([[0], np.searchsorted(self.t, self.ends[:-1]), [len(self.t)]])

    @property
    def valid(self) -> "Heard":
        """The readings that hold a value."""
        finite = np.isfinite(self.value)
        return self if finite.all() else self.of(finite)

    def by_source(self) -> "dict[int, Heard]":
        """The readings of each address, the most frequent first, then the lowest."""
        if len(self.t) and (self.source == self.source[0]).all():
            return {int(self.source[0]): self}
        counts = np.bincount(self.source)
        addresses = sorted(np.flatnonzero(counts).tolist(), key=lambda address: -counts[address])
        return {address: self.of(self.source == address) for address in addresses}

"""Eliminate the driving before a border in time: what it adds to the equations of the driving behind it.

The unknowns x, in order of time, have the precision L given the data, with the factor F (`conditioned`), and columns Y
of data the rows B = A' R^-1 Y. With the unknowns before the border numbered 1 and those behind it 2, block elimination
leaves the Schur complement

    L_22 - F_21 F_21',   B_2 - F_21 W_1,   Y' R^-1 Y - W_1' W_1,   F_11 W_1 = B_1

F_21 has a row for each unknown behind the border that is linked with one before it. F_11 and W_1 depend on nothing
behind the border: driving that follows changes none of these terms, and the elimination goes on from there.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.model.linear_gaussian import Factor
from estimator.model.road import RoadModel
from estimator.signals import Floats, Mask


@dataclass(frozen=True, kw_only=True)
class Border:
    """Driving before the time ``t`` [s], eliminated; r unknowns behind it are linked with those before it.

    ``information`` (r, r) is added to the precision of these r unknowns, which are of the ``kinds`` (r,), and ``rows``
    (r, c) to their rows of c columns of data. ``products`` (c, c) are those of the data before the border.
    """

    t: float
    information: Floats
    rows: Floats
    products: Floats
    kinds: NDArray[np.int8]

    @classmethod
    def of(
        cls, model: RoadModel, factor: Factor, variance: Floats, t: float, columns: Floats, whitened: Floats
    ) -> "Border":
        """Eliminate the driving before ``t`` [s], for data ``columns`` (sum of counts, c) and their W (size, c)."""
        begin = model.place_at(t)
        before, link = model.before(begin), _link(factor.lower, begin)
        r, near = link.shape
        weighed = np.where(np.concatenate(before)[:, None], columns / variance[:, None], 0.0)
        return cls(
            t=t,
            information=model.information_of(before, variance, begin, r) - link @ link.T,
            rows=model.gathered(weighed)[begin : begin + r] - link @ whitened[begin - near : begin],
            products=columns.T @ weighed - whitened[:begin].T @ whitened[:begin],
            kinds=model.kind_of[begin : begin + r],
        )

    def is_that_of(self, model: RoadModel) -> bool:
        """Whether a model of driving about the border has the same unknowns next behind it."""
        begin = model.place_at(self.t)
        return np.array_equal(model.kind_of[begin : begin + len(self.kinds)], self.kinds)

    def seen_behind(self, model: RoadModel) -> list[Mask]:
        """Which observations of each kind in a model depend on unknowns behind the border alone."""
        return [~early for early in model.before(model.place_at(self.t))]

    def add_information(self, target: Floats, begin: int) -> Floats:
        """The band ``target`` of unknowns of which those from ``begin`` on are behind the border, with its information.

        Those before it have a precision of 1, and no link.
        """
        r = len(self.information)
        target[:, :begin] = 0.0
        target[0, :begin] = 1.0
        wider: Floats = np.pad(target, ((0, max(r - len(target), 0)), (0, 0)))
        for down in range(r):
            wider[down, begin : begin + r - down] += np.diagonal(self.information, -down)
        return wider


def _link(lower: Floats, begin: int) -> Floats:
    """Block (r, c) of a factor, in lower storage, that links r unknowns from ``begin`` on with the c before them."""
    reach = len(lower) - 1
    columns = np.arange(max(begin - reach, 0), begin)
    down = begin + np.arange(min(reach, lower.shape[1] - begin))[:, None] - columns
    block = np.where(down <= reach, lower[np.minimum(down, reach), columns], 0.0)
    return block[: 1 + np.flatnonzero(block.any(axis=1)).max(initial=-1)]

"""Gram matrix of data columns, weighted by the inverse of their covariance and computed in pieces of time.

With the factor F of the precision of all unknowns given the data (`linear_gaussian`), columns Y of data have

    Y' K^-1 Y = Y' R^-1 Y - W' W,   F W = A' R^-1 Y

Unknowns are in order of time and F is banded. The elements of W in a piece so follow from the data there and from the
last elements of W before it, as a filter's estimate follows from its state. One piece of W is in memory at a time. A
column that is zero in a piece, with last elements c, continues as H c and adds c' (H'H) c, with one H for all columns.
Most columns of switching effects and of processes are zero at most times, and cost little there.
"""

from collections.abc import Sequence, Set
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg.lapack import dtbtrs

from estimator.model.linear_gaussian import Factor, Observations
from estimator.signals import Floats, Mask

Columns = Floats | sp.csc_array

ELEMENTS = 2**18  # of a piece with all columns, 2 MB, as much as a cache holds: a few columns go in one piece
MIN_PIECE = 1024  # unknowns: in shorter pieces the products of columns that are zero take the most time


def gram(factor: Factor, kinds: Sequence[tuple[Observations, slice]], variance: Floats, data: Columns) -> Floats:
    """Y' K^-1 Y (c, c) of data columns.

    Parameters
    ----------
    factor
        Factor F of the precision.
    kinds
        Map A and rows of the data of each kind of observations.
    variance
        Diagonal (n,) of R: variances of the data given the unknowns.
    data
        Columns Y (n, c); sparse if most elements are zero.
    """
    size, count = factor.lower.shape[1], data.shape[1]
    product = np.zeros((count, count))
    weight, whitened = 1 / np.sqrt(variance)[:, None], _Whitened(factor, product)
    behind = np.zeros((count, whitened.reach))
    length = max(ELEMENTS // max(count, 1), MIN_PIECE, whitened.reach)
    begins = [*range(0, max(size - whitened.reach, 1), length)]  # no piece but the only one is shorter than the reach
    pieces = list(pairwise([*begins, size]))
    ends = {rows.start + observed.within(0, stop).stop for _, stop in pieces for observed, rows in kinds}
    columns = _Columns(data, {*ends, *(rows.start for _, rows in kinds)})
    for begin, stop in pieces:
        width, parts = stop - begin, list[tuple[Observations, slice, NDArray[np.intp], Floats]]()
        is_active: Mask = np.any(behind, axis=1)
        for observed, rows in kinds:
            part = observed.within(begin, stop)
            here = slice(rows.start + part.start, rows.start + part.stop)
            there, values = columns.nonzero(here)
            if len(there):
                scaled = values * weight[here]
                product[np.ix_(there, there)] += scaled.T @ scaled
                is_active[there] = True
                parts.append((observed, part, there, scaled * weight[here]))
        # Column by column, as LAPACK has it; what lies behind the piece is the beginning of the next.
        column_of, next_behind = np.cumsum(is_active) - 1, np.zeros_like(behind)
        gathered = np.zeros((np.count_nonzero(is_active), width))
        reaching = min(whitened.reach, width)
        gathered[:, :reaching] = behind[is_active, :reaching]
        for observed, part, there, weighed in parts:
            added = observed.gathered_within(part, weighed, begin, min(width + whitened.reach, size - begin)).T
            gathered[column_of[there]] += added[:, :width]
            next_behind[there, : added.shape[1] - width] += added[:, width:]
        behind = next_behind
        whitened.add(begin, is_active, gathered.T)
    return product


class _Columns:
    """Columns of data (n, c), for pieces of rows between two of ``edges``; those that are zero there are left out."""

    def __init__(self, data: Columns, edges: Set[int]) -> None:
        self._data = data
        self._first: dict[int, NDArray[np.int64]] = {}  # by row, number (c,) of the first element from that row on
        if not isinstance(data, np.ndarray):
            data.sort_indices()
            rows = np.array(sorted(edges), dtype=data.indices.dtype)
            numbers = [
                begin + np.searchsorted(data.indices[begin:end], rows) for begin, end in pairwise(data.indptr.tolist())
            ]
            self._first = dict(zip(rows.tolist(), np.array(numbers).T, strict=True))

    def nonzero(self, here: slice) -> tuple[NDArray[np.intp], Floats]:
        """Indices (k,) of columns with a non-zero element in the rows ``here`` (m,), and those columns (m, k)."""
        data = self._data
        if isinstance(data, np.ndarray):
            rows = data[here]
            there = np.flatnonzero(rows.any(axis=0))
            return there, rows if len(there) == rows.shape[1] else rows[:, there]
        first, end = self._first[here.start], self._first[here.stop]
        there = np.flatnonzero(end > first)
        counts = (end - first)[there]
        elements = np.arange(counts.sum()) + np.repeat(end[there] - np.cumsum(counts), counts)
        columns = np.zeros((here.stop - here.start, len(there)))
        columns[data.indices[elements] - here.start, np.repeat(np.arange(len(there)), counts)] = data.data[elements]
        return there, columns


class _Whitened:
    """Subtracts W' W from ``product`` (c, c), for columns W that come in pieces."""

    def __init__(self, factor: Factor, product: Floats) -> None:
        self._lower, self.reach, self._product = factor.lower, len(factor.lower) - 1, product
        self._last = np.zeros((self.reach, len(product)))  # elements before the next piece
        self._row, self._column = np.indices((self.reach, self.reach))

    def add(self, begin: int, is_active: Mask, columns: Floats) -> None:
        """Add the piece of F W from row ``begin`` on: ``columns`` (m, k) of those that are ``is_active`` (c,)."""
        link = self._coupling(begin)[: len(columns)]
        columns[: len(link)] += link @ self._last[:, is_active]
        W = self._solved(begin, columns)
        self._product[np.ix_(is_active, is_active)] -= W.T @ W
        last = np.zeros_like(self._last)
        last[-len(W) :, is_active] = W[-self.reach :]  # of the last piece, which may be shorter, nothing is needed
        going = np.flatnonzero(np.where(is_active, False, self._last.any(axis=0)))
        if len(going):
            answers = np.zeros((len(columns), self.reach), order="F")
            answers[: len(link)] = link
            H, state = self._solved(begin, answers), self._last[:, going]
            self._product[np.ix_(going, going)] -= state.T @ (H.T @ H) @ state
            cross = (W.T @ H) @ state
            self._product[np.ix_(is_active, going)] -= cross
            self._product[np.ix_(going, is_active)] -= cross.T
            last[-len(H) :, going] = H[-self.reach :] @ state
        self._last = last

    def _coupling(self, begin: int) -> Floats:
        """Matrix (reach, reach) from elements before ``begin`` to their part of the right-hand side behind it."""
        if not begin:
            return np.zeros((self.reach, self.reach))
        down = np.minimum(self.reach + self._row - self._column, self.reach)
        below = self._lower[down, begin - self.reach + self._column]
        added: Floats = -np.triu(below)
        return added

    def _solved(self, begin: int, columns: Floats) -> Floats:
        """Solve the block of F from ``begin`` on for ``columns`` (m, c), which are overwritten."""
        if not columns.size:  # without columns, scipy's call of LAPACK spoils memory
            return columns
        solved: Floats = dtbtrs(self._lower[:, begin : begin + len(columns)], columns, uplo="L", overwrite_b=1)[0]
        return solved

"""Rows of one time in a table: signals of several rates are often exported as rows that fill columns of their own."""

import numpy as np
from numpy.typing import NDArray

from estimator.signals import Floats


class SameTimes:
    """Joins the rows of one time to one row, piece by piece; a cell whose column has a value at its time is refused.

    Attributes
    ----------
    times : int
        Times so far.
    refused : int
        Rows with a refused cell.
    first : int
        Number of the first of them, from 1; 0 if there is none.
    """

    def __init__(self, columns: int) -> None:
        self.times, self.refused, self.first = 0, 0, 0
        self._fed = 0  # rows
        self._t, self._values = np.empty(0), np.empty((0, columns))  # of the last time, which may go on

    def feed(self, t: Floats, values: Floats) -> tuple[Floats, Floats]:
        """Take the next rows, and give those that no later one belongs to.

        Parameters
        ----------
        t
            Times (n,) [s] that do not fall.
        values
            Cells (n, k) in the units of their columns; NaN is no value.

        Returns
        -------
        tuple[Floats, Floats]
            Rising times (m,) [s], and their cells (m, k), NaN for those without a value.
        """
        held = len(self._t)
        all_t, cells = np.concatenate([self._t, t]), np.concatenate([self._values, values])
        is_later = np.diff(all_t, prepend=-np.inf) > 0
        times, at = all_t[is_later], np.cumsum(is_later) - 1
        column, row = np.nonzero(~np.isnan(cells).T)
        is_first = np.diff(column * len(times) + at[row], prepend=-1) > 0  # of its column and time
        joined = np.full((len(times), cells.shape[1]), np.nan)
        joined[at[row[is_first]], column[is_first]] = cells[row[is_first], column[is_first]]
        self._count(np.unique(row[~is_first]) - held, len(times) - held)
        self._fed += len(t)
        self._t, self._values = times[-1:], joined[-1:]
        return times[:-1], joined[:-1]

    def finish(self) -> tuple[Floats, Floats]:
        """The row of the last time, if there is one."""
        return self._t, self._values

    def _count(self, refused: NDArray[np.intp], times: int) -> None:
        """Count the new ``times``, and the ``refused`` among the new rows."""
        self.times += times
        self.refused += len(refused)
        if len(refused):
            self.first = self.first or self._fed + int(refused[0]) + 1

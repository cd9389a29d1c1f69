"""Linear Gaussian models with a banded precision: the likelihood of n observations in O(n).

Unknowns x (size,) have a Gaussian prior of precision Q, and observations are linear in them:

    data_k = sum_q weight_kq x[place_kq] + e_k,   e_k ~ N(0, variance_k)

The places of one observation lie near each other, and Q is banded, so the precision of x given the data,
L = Q + A' R^-1 A, is banded too, and a banded Cholesky factor gives, for any columns Y of data,

    Y' K^-1 Y = Y' R^-1 Y - (A' R^-1 Y)' L^-1 (A' R^-1 Y),      log|K| = log|R| + log|L| - log|Q|

where K = R + A Q^-1 A' is the covariance of the data (Woodbury identity; Rue & Held 2005, chapter 2).

Bands are stored as LAPACK stores the lower triangle: ``band[d, j]`` is the element (j + d, j).
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbtrf, dtbtrs

from estimator.signals import Floats

Places = NDArray[np.int64]


class NotPositiveDefiniteError(ArithmeticError):
    """The precision is not positive definite in floating point: the scales of its parts lie too far apart."""


def bandwidth(places: Places) -> int:
    """How far apart (n, q) places of one observation are at most."""
    return int((places.max(axis=1) - places.min(axis=1)).max()) if places.size else 0


def band(rows: Places, columns: Places, values: Floats, shape: tuple[int, int]) -> Floats:
    """Band of ``shape`` (bandwidth + 1, size) of the symmetric matrix with elements (m,) of its lower triangle.

    Elements above the diagonal are left out; elements given twice add up.
    """
    lower = rows >= columns
    stored = np.zeros(shape)
    np.add.at(stored, ((rows - columns)[lower], columns[lower]), values[lower])
    return stored


class Observations:
    """The linear map A of n observations, in the two forms that the likelihood needs.

    Parameters
    ----------
    places
        Unknowns that an observation depends on (n, q); a weight of zero makes a place irrelevant.
    weights
        Their factors (n, q).
    shape
        Of the band of the precision: (bandwidth + 1, size).
    """

    def __init__(self, places: Places, weights: Floats, shape: tuple[int, int]) -> None:
        n, q = places.shape
        self._shape = shape
        self._gather = sp.csr_matrix((weights.T.ravel(), (places.T.ravel(), np.tile(np.arange(n), q))), (shape[1], n))
        rows, columns, values = [], [], []
        for a in range(q):
            for b in range(q):
                apart = places[:, a] - places[:, b]
                lower = np.flatnonzero(apart >= 0)
                rows.append(apart[lower] * shape[1] + places[lower, b])
                columns.append(lower)
                values.append(weights[lower, a] * weights[lower, b])
        elements = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
        self._square = sp.csr_matrix(elements, (shape[0] * shape[1], n))

    def information(self, variance: Floats) -> Floats:
        """The band of A' R^-1 A, for variances (n,)."""
        stored: Floats = (self._square @ (1 / variance)).reshape(self._shape)
        return stored

    def gathered(self, scaled: Floats) -> Floats:
        """A' times columns (n, c)."""
        total: Floats = self._gather @ scaled
        return total

    def observed(self, unknowns: Floats) -> Floats:
        """A times ``unknowns`` (size,)."""
        seen: Floats = self._gather.T @ unknowns
        return seen


@dataclass(frozen=True)
class Factor:
    """Cholesky factor of a banded precision, in LAPACK's lower storage."""

    lower: Floats

    @classmethod
    def of(cls, precision: Floats) -> "Factor":
        """Factor a band (bandwidth + 1, size), which is overwritten.

        Raises
        ------
        NotPositiveDefiniteError
            It is not positive definite.
        """
        lower, failed = dpbtrf(precision, lower=1, overwrite_ab=1)
        if failed:
            raise NotPositiveDefiniteError
        return cls(lower)

    @property
    def log_determinant(self) -> float:
        """log|L| of the precision."""
        return 2 * float(np.log(self.lower[0]).sum())

    def whiten(self, columns: Floats) -> Floats:
        """The factor's inverse times ``columns`` (size, c)."""
        solved, _ = dtbtrs(self.lower, columns, uplo="L")
        whitened: Floats = solved
        return whitened

    def solve(self, columns: Floats) -> Floats:
        """L^-1 times ``columns`` (size, c)."""
        return self.unwhiten(self.whiten(columns))

    def unwhiten(self, columns: Floats) -> Floats:
        """The inverse of the factor's transpose times ``columns`` (size, c): white noise becomes draws of the prior."""
        solved, _ = dtbtrs(self.lower, columns, uplo="L", trans="T")
        solution: Floats = solved
        return solution

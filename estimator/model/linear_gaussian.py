"""Linear Gaussian models with a banded precision: the likelihood of n observations in O(n).

Unknowns x (size,) have a Gaussian prior of precision Q, and observations are linear in them:

    data_k = sum_q weight_kq x[place_kq] + e_k,   e_k ~ N(0, variance_k)

The places of one observation lie near each other, and Q is banded. The precision of x given the data,
L = Q + A' R^-1 A, is therefore banded too. Its banded Cholesky factor gives, for any columns Y of data,

    Y' K^-1 Y = Y' R^-1 Y - (A' R^-1 Y)' L^-1 (A' R^-1 Y),      log|K| = log|R| + log|L| - log|Q|

where K = R + A Q^-1 A' is the covariance of the data (Woodbury identity; Rue & Held 2005, chapter 2). The covariance
L^-1 is dense, but its elements within the band follow from those of the factor (Takahashi, Fagan & Chen 1973).

Bands are stored as LAPACK stores the lower triangle: ``band[d, j]`` is the element (j + d, j).
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray
from scipy.linalg.lapack import dpbtrf, dtbtrs, dtrtri

from estimator.signals import Floats, Mask

Places = NDArray[np.int64]

MIN_BLOCK = 16  # unknowns of a block: narrower bands go as fast
SEGMENT = 64  # blocks whose part of the covariance is made at once: bounds the memory beside the band itself
CHUNK = 16  # columns that are whitened at once, from the first element of any on


class NotPositiveDefiniteError(ArithmeticError):
    """Raised if a precision is not positive definite in floating point: the scales of its parts lie too far apart."""


def bandwidth(places: Places) -> int:
    """Largest distance between two places of one observation, of ``places`` (n, q)."""
    return int((places.max(axis=1) - places.min(axis=1)).max()) if places.size else 0


def band(rows: Places, columns: Places, values: Floats, shape: tuple[int, int]) -> Floats:
    """Band of ``shape`` (bandwidth + 1, size) of the symmetric matrix with elements (m,) of its lower triangle.

    Elements above the diagonal are left out; elements given twice add up.
    """
    lower = rows >= columns
    stored = np.zeros(shape)
    np.add.at(stored, ((rows - columns)[lower], columns[lower]), values[lower])
    return stored


def dense(stored: Floats) -> Floats:
    """Symmetric matrix (size, size) of a band (bandwidth + 1, size); elements beyond the last row are left out."""
    size = stored.shape[1]
    row, column = np.indices((size, size))
    apart = np.abs(row - column)
    last = len(stored) - 1
    inside: Floats = np.where(apart <= last, stored[np.minimum(apart, last), np.minimum(row, column)], 0.0)
    return inside


def both_triangles(stored: Floats) -> Floats:
    """Double the elements off the diagonal in place: sums over the band become sums over the whole matrix."""
    stored[1:] *= 2
    return stored


def add_squares(target: Floats, columns: Floats) -> None:
    """Add x x' (summed over ``columns`` x (size, c)) to a band (bandwidth + 1, size) of `both_triangles`."""
    target[0] += np.einsum("ij,ij->i", columns, columns)
    for down in range(1, min(len(target), len(columns))):
        target[down, :-down] += 2 * np.einsum("ij,ij->i", columns[down:], columns[:-down])


def _by_observation(rows: Places, values: Floats, size: int) -> sp.csc_matrix:
    """Sparse matrix (size, n): column k has ``values[k]`` (q,) at ``rows[k]`` (q,); values of equal rows add up."""
    n, q = rows.shape
    made = sp.csc_matrix((values.ravel(), rows.ravel(), np.arange(0, n * q + 1, q)), (size, n), copy=True)
    made.sort_indices()
    return made


class Observations:
    """Linear map A of n observations, in the two forms that the likelihood needs.

    Parameters
    ----------
    places
        Unknowns that each observation depends on (n, q); a weight of zero makes a place irrelevant.
    weights
        Factors of these unknowns (n, q).
    shape
        Shape of the band of the precision: (bandwidth + 1, size).
    """

    def __init__(self, places: Places, weights: Floats, shape: tuple[int, int]) -> None:
        q = places.shape[1]
        self._first = places.min(axis=1)
        self._gather = _by_observation(places, weights, shape[1])
        self._see = self._gather.T
        # Each pair of an observation's places once, the later one in front; of two equal ones both orders count.
        first, second = np.triu_indices(q)
        apart = places[:, first] - places[:, second]
        twice = np.where((apart == 0) & (first != second), 2.0, 1.0)
        stored = np.abs(apart) * shape[1] + np.minimum(places[:, first], places[:, second])
        is_touched = np.zeros(shape[0] * shape[1], dtype=bool)
        is_touched[stored] = True
        self._touched = np.flatnonzero(is_touched)  # of the band: most of it is zero
        number = np.empty(len(is_touched), dtype=np.int32)  # among those touched
        number[self._touched] = np.arange(len(self._touched))
        values = weights[:, first] * weights[:, second] * twice
        self._square = _by_observation(number[stored], values, len(self._touched))
        self._spread = self._square.T

    def add_information(self, target: Floats, variance: Floats) -> None:
        """Add A' R^-1 A, for variances (n,), to a band ``target`` (bandwidth + 1, size)."""
        target.ravel()[self._touched] += self._square @ (1 / variance)

    def variance(self, products: Floats) -> Floats:
        """Variance of A x (n,), for unknowns x whose covariance is given as `both_triangles`."""
        spread: Floats = self._spread @ products.ravel()[self._touched]
        return spread

    def before(self, begin: int) -> Mask:
        """Which observations (n,) depend on an unknown before ``begin``."""
        before: Mask = self._first < begin
        return before

    def within(self, begin: int, end: int) -> slice:
        """Range of the observations whose first unknown is in the half-open interval ``begin`` to ``end``."""
        first, last = np.searchsorted(self._first, [begin, end]).tolist()
        return slice(first, last)

    def gathered(self, scaled: Floats) -> Floats:
        """A' times columns (n, c)."""
        total: Floats = self._gather @ scaled
        return total

    def gathered_within(self, part: slice, scaled: Floats, begin: int, length: int) -> Floats:
        """Elements (length, c) from ``begin`` on of A' times columns (m, c) of the observations in ``part``.

        These observations must depend on no other unknowns.
        """
        whole = self._gather
        if whole.shape == (length, len(scaled)):
            return self.gathered(scaled)
        elements = slice(whole.indptr[part.start], whole.indptr[part.stop])
        kept = whole.data[elements], whole.indices[elements] - begin, whole.indptr[: len(scaled) + 1]
        total: Floats = sp.csc_array(kept, (length, len(scaled))) @ scaled
        return total

    def observed(self, unknowns: Floats) -> Floats:
        """A times ``unknowns`` (size,)."""
        seen: Floats = self._see @ unknowns
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
            The precision is not positive definite.
        """
        lower, failed = dpbtrf(precision, lower=1, overwrite_ab=1)
        if failed:
            raise NotPositiveDefiniteError("a precision is not positive definite")
        return cls(lower)

    @property
    def log_determinant(self) -> float:
        """Logarithm of the determinant of the precision, log|L|."""
        return 2 * float(np.log(self.lower[0]).sum())

    def whiten(self, columns: Floats) -> Floats:
        """Inverse of the factor times ``columns`` (size, c); leading zeros of a column stay zero."""
        first = np.argmax(columns != 0, axis=0)
        order = np.argsort(first, kind="stable")
        whitened = np.zeros(columns.shape, order="F")
        for at in range(0, len(order), CHUNK):
            chunk = order[at : at + CHUNK]
            begin = first[chunk[0]]
            whitened[begin:, chunk], _ = dtbtrs(self.lower[:, begin:], columns[begin:, chunk], uplo="L")
        return whitened

    def solve(self, columns: Floats) -> Floats:
        """L^-1 times ``columns`` (size, c)."""
        return self.unwhiten(self.whiten(columns))

    def unwhiten(self, columns: Floats) -> Floats:
        """Inverse of the factor's transpose times ``columns`` (size, c): white noise gets the covariance L^-1."""
        solved, _ = dtbtrs(self.lower, columns, uplo="L", trans="T")
        solution: Floats = solved
        return solution

    def covariance(self) -> Floats:
        """Band (bandwidth + 1, size) of L^-1.

        With the factor cut into blocks D on the diagonal and E below them, from the last block to the first:

            S_ki = -S_kk G,   S_ii = (D D')^-1 + G' S_kk G,   G = E D^-1,   k = i + 1
        """
        reach, size = len(self.lower) - 1, self.lower.shape[1]
        width = max(reach, MIN_BLOCK)
        inverse_band, after = np.empty((reach + 1, size)), np.zeros((width, width))
        for begin in reversed(range(0, size, SEGMENT * width)):
            part = self.lower[:, begin : begin + SEGMENT * width].T
            number = -(-len(part) // width)
            padded = np.zeros((number * width, reach + 1))
            padded[: len(part)], padded[len(part) :, 0] = part, 1.0
            blocks, stored = _blocks(number, width, reach)
            stored[:] = padded.reshape(stored.shape)
            inverse = blocks[:, :width]
            for block in inverse:
                dtrtri(block.T, lower=0, overwrite_c=1)
            diagonal, turned = inverse.transpose(0, 2, 1) @ inverse, blocks[:, width:] @ inverse
            across, product = np.empty_like(turned), np.empty((width, width))
            for turn, S_kk_G, S_ii in zip(turned[::-1], across[::-1], diagonal[::-1], strict=True):
                np.dot(after, turn, out=S_kk_G)
                S_ii += np.dot(turn.T, S_kk_G, out=product)
                after = S_ii
            blocks[:, :width] = diagonal
            np.negative(across, out=blocks[:, width:])
            padded.reshape(stored.shape)[:] = stored
            inverse_band[:, begin : begin + len(part)] = padded[: len(part)].T
        return inverse_band


def _blocks(number: int, width: int, reach: int) -> tuple[Floats, Floats]:
    """Two views of one memory of zeros: as blocks and as a band.

    The blocks (number, 2 width, width) are those on the diagonal over those below it. The band is (number, width,
    reach + 1), with element (i, j, d) at (i, j + d, j) of the blocks.
    """
    blocks = np.zeros((number, 2 * width, width))
    block, row, column = blocks.strides
    stored = as_strided(blocks, (number, width, reach + 1), (block, row + column, row))
    return blocks, stored

"""A Gaussian process over distance or time as a Gaussian Markov field on nodes: Matern covariance in O(n).

The stationary solution of (kappa^2 - d^2/ds^2)^(alpha/2) x = white noise has a Matern covariance of smoothness
nu = alpha - 1/2 (Whittle 1954). On nodes joined by linear elements its precision is banded (Lindgren, Rue & Lindstroem
2011). With the lumped mass matrix M and the stiffness matrix G it is

    Q = tau (kappa^2 M + G) (M^-1 (kappa^2 M + G))^(alpha - 1),   kappa = sqrt(2 nu) / length,
    tau = Gamma(nu) / (Gamma(alpha) sqrt(4 pi) kappa^(2 nu) sd^2)

This is a polynomial in kappa^2 with fixed bands, so other scales need no new assembly. The ends of a stretch are free
(Neumann boundary), where the variance doubles.
"""

from math import comb, gamma, pi, sqrt

import numpy as np
from scipy.linalg import cholesky_banded, solveh_banded
from scipy.linalg.lapack import dpttrf

from estimator.model.linear_gaussian import Places
from estimator.signals import Floats


class MaternField:
    """Precision of a Matern process at nodes along stretches of road, or of time.

    Parameters
    ----------
    nodes
        Distances [m] or times [s] (N,), ascending.
    joined
        True (N,) where a node belongs to the stretch of the node before it; False for the first.
    alpha
        Order of the operator: 2, 3, 4 for a smoothness nu of 3/2, 5/2, 7/2.
    places
        Indices of the nodes among the unknowns (N,), ascending.
    shape
        Shape of the band of the precision of all unknowns, (bandwidth + 1, size).
    """

    def __init__(self, nodes: Floats, joined: np.ndarray, alpha: int, places: Places, shape: tuple[int, int]) -> None:
        n = len(nodes)
        width = np.where(joined[1:], np.diff(nodes), np.inf)
        half = np.where(joined[1:], width / 2, 0.0)
        mass = np.append(half, 0.0) + np.insert(half, 0, 0.0)
        mass[mass == 0] = 1.0  # a node alone
        pull = 1 / width
        self._mass, self._off = mass, -pull
        self._diagonal = np.append(pull, 0.0) + np.insert(pull, 0, 0.0)
        stiffness = np.stack([np.insert(self._off, 0, 0.0), self._diagonal, np.append(self._off, 0.0)])
        self.alpha, self.size, self.places = alpha, n, places
        powers = [mass[None], stiffness]
        for _ in range(alpha - 1):
            powers.append(_product(stiffness, 1 / mass, powers[-1]))
        self._touched, self._powers = _lower(powers, places, shape[1])
        self._powers *= np.array([comb(alpha, k) for k in range(alpha + 1)])[:, None]

    @property
    def _nu(self) -> float:
        """Smoothness nu."""
        return self.alpha - 0.5

    def _kappa_tau(self, sd: float, length: float) -> tuple[float, float]:
        nu = self._nu
        kappa = sqrt(2 * nu) / length
        return kappa, gamma(nu) / (gamma(self.alpha) * sqrt(4 * pi) * kappa ** (2 * nu) * sd**2)

    def _factors(self, kappa: float, tau: float) -> Floats:
        """Factors (alpha + 1,) of the terms of the polynomial in kappa^2."""
        factors: Floats = tau * kappa ** (2.0 * (self.alpha - np.arange(self.alpha + 1)))
        return factors

    def _operator(self, kappa: float) -> Floats:
        """Band (2, N) of kappa^2 M + G."""
        return np.vstack([kappa**2 * self._mass + self._diagonal, np.append(self._off, 0.0)])

    def add_precision(self, target: Floats, sd: float, length: float) -> float:
        """Add the precision for ``sd`` and correlation ``length`` to a band ``target`` (bandwidth + 1, size).

        Returns log|Q|.
        """
        kappa, tau = self._kappa_tau(sd, length)
        target.ravel()[self._touched] += self._factors(kappa, tau) @ self._powers
        diagonal = cholesky_banded(self._operator(kappa), lower=True)[0]
        return float(
            2 * self.alpha * np.log(diagonal).sum()
            - (self.alpha - 1) * np.log(self._mass).sum()
            + self.size * np.log(tau)
        )

    def score(self, products: Floats, sd: float, length: float) -> Floats:
        """Derivative (2,) of the log density by log ``sd`` and log ``length``.

        ``products`` is the mean of x x', as `both_triangles`.
        """
        kappa, tau = self._kappa_tau(sd, length)
        terms = self._factors(kappa, tau) * (self._powers @ products.ravel()[self._touched])
        orders = 2 * (self.alpha - np.arange(self.alpha + 1)) - 2 * self._nu  # of kappa in the factors
        inverse = _inverse_diagonal(*self._operator(kappa))
        by_kappa = (
            self.alpha * kappa**2 * float(self._mass @ inverse) - self._nu * self.size - 0.5 * float(orders @ terms)
        )
        return np.array([terms.sum() - self.size, -by_kappa])

    def response(self, x: Floats, sd: float, length: float) -> Floats:
        """Product V' V^-1 ``x`` (N, 2), with V the covariance and V' its derivative by log ``sd`` or log ``length``."""
        kappa, _ = self._kappa_tau(sd, length)
        smoothed = solveh_banded(self._operator(kappa), self._mass * x, lower=True)
        return np.column_stack([2 * x, 2 * self.alpha * kappa**2 * smoothed - 2 * self._nu * x])


def _inverse_diagonal(diagonal: Floats, off: Floats) -> Floats:
    """Diagonal (N,) of the inverse of a tridiagonal positive definite matrix of two rows or more.

    ``off`` (N,) are the elements beside the diagonal; the last one is not used.

    Element i of the inverse is 1 / (p_i + q_i - d_i), with d the diagonal. The pivots p and q are those of the
    factorisations from the first and from the last row.
    """
    before, behind = dpttrf(diagonal, off[:-1])[0], dpttrf(diagonal[::-1], off[-2::-1])[0][::-1]
    inverse: Floats = 1 / (before + behind - diagonal)
    return inverse


def _product(stiffness: Floats, scale: Floats, power: Floats) -> Floats:
    """Diagonals (2 r + 3, N) of the product S diag(scale) P.

    Row r + d of diagonals (2 r + 1, N) holds the elements (i, i + d) at places i; S has those of r = 1.
    """
    product = np.zeros((len(power) + 2, power.shape[1]))
    for ahead in (1, 0, -1):  # elements rolled over the ends meet zeros of S
        factor = stiffness[1 + ahead] * np.roll(scale, -ahead)
        product[1 + ahead : 1 + ahead + len(power)] += factor * np.roll(power, -ahead, axis=1)
    return product


def _lower(powers: list[Floats], places: Places, size: int) -> tuple[Places, Floats]:
    """Flat indices (m,) into a band of ``size`` unknowns, and values there (len(powers), m), of symmetric matrices.

    Each of the ``powers`` is given by its diagonals (2 r + 1, N), and acts on the unknowns ``places`` (N,). Elements
    that are zero in all of them are left out.
    """
    n, reach = len(places), min(len(powers[-1]) // 2 + 1, len(places))
    where = np.concatenate([(places[down:] - places[: n - down]) * size + places[: n - down] for down in range(reach)])
    values = np.zeros((len(powers), len(where)))
    for value, diagonals in zip(values, powers, strict=True):
        middle, begin = len(diagonals) // 2, 0
        for down in range(min(middle + 1, reach)):
            value[begin : begin + n - down] = diagonals[middle - down, down:]
            begin += n - down
    order = np.argsort(where, kind="stable")
    order = order[np.any(values[:, order], axis=0)]
    return where[order], values[:, order]

"""Ornstein-Uhlenbeck process at given times as a Gaussian Markov chain: stationary noise that is correlated in time."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from estimator.model.linear_gaussian import Places
from estimator.signals import Floats


@dataclass(frozen=True)
class Chain:
    """Process at times ``t`` (n,) [s], with its values at ``places`` (n,) among the unknowns.

    Neighbours that are ``linked`` (n - 1,) have the correlation exp(-dt / time); the others are independent.
    """

    t: Floats
    places: Places
    linked: NDArray[np.bool_]

    def _bands(self, sd: float, time: float) -> tuple[Floats, Floats]:
        """Correlation (n - 1,) of neighbours, and precision (n,) of each value given the one before it."""
        keep = np.where(self.linked, np.exp(-np.diff(self.t) / time), 0.0)
        return keep, np.insert(1 / (1 - keep**2), 0, 1.0) / sd**2

    def add_precision(self, target: Floats, sd: float, time: float) -> float:
        """Add the precision for a standard deviation and a correlation ``time`` [s] to a band; returns log|Q|.

        x_k given x_(k-1) is N(rho x_(k-1), sd^2 (1 - rho^2)).
        """
        keep, weight = self._bands(sd, time)
        diagonal = weight.copy()
        diagonal[:-1] += keep**2 * weight[1:]
        target[0, self.places] += diagonal
        on = np.flatnonzero(self.linked)
        before, after = self.places[on], self.places[on + 1]
        target[after - before, before] -= (keep * weight[1:])[on]
        return float(np.log(weight).sum())

    def score(self, products: Floats, sd: float, time: float) -> Floats:
        """Derivative (2,) of the log density by log ``sd`` and log ``time``.

        ``products`` is the mean of x x', as `both_triangles`.
        """
        keep, weight = self._bands(sd, time)
        rate = np.diff(self.t) / time * keep  # of the correlation, by log time
        square, cross = products[0, self.places], np.zeros(len(keep))
        on = np.flatnonzero(self.linked)
        cross[on] = products[self.places[on + 1] - self.places[on], self.places[on]]
        misfit = square.copy()  # of each value given the one before
        misfit[1:] += keep**2 * square[:-1] - keep * cross
        by_keep = keep * sd**2 * weight[1:] * (1 - weight[1:] * misfit[1:])
        by_keep += weight[1:] * (0.5 * cross - keep * square[:-1])
        return np.array([weight @ misfit - len(weight), by_keep @ rate])

    def response(self, x: Floats, sd: float, time: float) -> Floats:
        """Product V' V^-1 ``x`` (n, 2), with V the covariance and V' its derivative by log ``sd`` or log ``time``."""
        keep, weight = self._bands(sd, time)
        rate = np.diff(self.t) / time * keep
        by_keep = 2 * keep * sd**2 * weight[1:] ** 2  # of the precision of each value given the one before
        diagonal = np.insert(by_keep * rate, 0, 0.0)
        diagonal[:-1] += (2 * keep * weight[1:] + keep**2 * by_keep) * rate
        below = -(weight[1:] + keep * by_keep) * rate
        turned = diagonal * x
        turned[1:] += below * x[:-1]
        turned[:-1] += below * x[1:]
        whole = weight.copy()
        whole[:-1] += keep**2 * weight[1:]
        precision = np.vstack([whole, np.append(-keep * weight[1:], 0.0)])
        return np.column_stack([2 * x, -solveh_banded(precision, turned, lower=True)])


def mean_given_ends(length: float, time: float) -> tuple[float, float]:
    """Weight w and variance r of the mean over ``length`` [s] of a process of variance 1, given its ends x_0 and x_1.

    The mean is w (x_0 + x_1) plus independent noise of variance r. Both follow from the moments of the process and of
    its integral; w = tanh(u / 2) / u with u = length / time.
    """
    u = length / time
    keep = np.exp(-u)
    weight = float(np.tanh(u / 2) / u)
    variance = 2 * (u - 1 + keep) / u**2
    with_end = (1 - keep) / u
    return weight, float(max(variance - 2 * with_end**2 / (1 + keep), 1e-12))


def mean_given_ends_by_time(length: float, time: float) -> tuple[float, float]:
    """Derivatives of log w and of r of `mean_given_ends` by log ``time``."""
    u = length / time
    keep = np.exp(-u)
    weight = np.tanh(u / 2) / u
    with_end = (1 - keep) / u
    of_weight = (1 - np.tanh(u / 2) ** 2) / (2 * u) - weight / u
    of_end = (keep - with_end) / u
    of_variance = 2 * (1 - keep) / u**2 - 4 * (u - 1 + keep) / u**3
    of_variance -= 4 * with_end * of_end / (1 + keep) + 2 * with_end**2 * keep / (1 + keep) ** 2
    return float(-u * of_weight / weight), float(-u * of_variance)

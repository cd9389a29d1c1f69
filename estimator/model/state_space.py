"""A Matern process as a state that goes on from place to place: the same process as `matern`, one place at a time.

The stationary solution of (kappa + d/ds)^alpha x = white noise has a Matern covariance of smoothness nu = alpha - 1/2,
and so is a Markov process of its first alpha - 1 derivatives (Hartikainen & Sarkka 2010). Over u = kappa ds, with the
k-th derivative divided by kappa^k, the state goes on by

    F = exp(A u) = exp(-u) sum_j (N u)^j / j!,   N = A + 1 (nilpotent),   Q = P - F P F'

with A the companion matrix of (1 + d/du)^alpha and P the stationary covariance. Order 1 is an Ornstein-Uhlenbeck
process, with the length in the place of the time.
"""

from functools import cache
from math import comb, exp, factorial, sqrt

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from estimator.signals import Floats


def rate(alpha: int, length: float) -> float:
    """Kappa [1/m] or [1/s] of a process of order ``alpha`` and a correlation ``length`` [m] or [s], as in `matern`."""
    return sqrt(2 * alpha - 1) / length


def passage(alpha: int, u: float) -> tuple[Floats, Floats]:
    """Transition (alpha, alpha) over a scaled distance ``u`` [1] and covariance of its noise, of a process of sd 1."""
    powers, covariance = _process(alpha)
    transition: Floats = exp(-u) * (u ** np.arange(alpha) @ powers).reshape(alpha, alpha)
    noise: Floats = covariance - transition @ covariance @ transition.T
    return transition, noise


def stationary(alpha: int) -> Floats:
    """Covariance (alpha, alpha) of the process of sd 1 and its scaled derivatives."""
    return _process(alpha)[1]


@cache
def _process(alpha: int) -> tuple[Floats, Floats]:
    """N^j / j! for j below alpha, as rows (alpha, alpha^2), and the stationary covariance (alpha, alpha)."""
    companion = np.eye(alpha, k=1)
    companion[-1] = [-comb(alpha, k) for k in range(alpha)]
    noise = np.zeros((alpha, alpha))
    noise[-1, -1] = 1.0
    covariance: Floats = solve_continuous_lyapunov(companion, -noise)
    shift = companion + np.eye(alpha)
    powers = np.array([np.linalg.matrix_power(shift, j).ravel() / factorial(j) for j in range(alpha)])
    return powers, 0.5 * (covariance + covariance.T) / covariance[0, 0]

"""Matern process in state-space form: the process of `matern`, computed one place at a time.

The stationary solution of (kappa + d/ds)^alpha x = white noise has a Matern covariance of smoothness nu = alpha - 1/2.
With its first alpha - 1 derivatives it is a Markov process (Hartikainen & Sarkka 2010). Let u = kappa ds, and divide
the k-th derivative by kappa^k. The transition matrix F and the noise covariance Q of the state are then

    F = exp(A u) = exp(-u) sum_j (N u)^j / j!,   N = A + 1 (nilpotent),   Q = P - F P F'

with A the companion matrix of (1 + d/du)^alpha and P the stationary covariance. Order 1 is an Ornstein-Uhlenbeck
process, with the length as its correlation time.
"""

from functools import cache
from math import comb, exp, factorial, sqrt

import numpy as np
from scipy.linalg import solve_continuous_lyapunov

from estimator.signals import Floats


def rate(alpha: int, length: float) -> float:
    """Rate kappa [1/m] or [1/s] of a process of order ``alpha`` and correlation ``length`` [m] or [s], see `matern`."""
    return sqrt(2 * alpha - 1) / length


def passage(alpha: int, u: float) -> tuple[Floats, Floats]:
    """Transition F and noise covariance Q, both (alpha, alpha), over a scaled distance ``u`` [1], for sd 1."""
    powers, covariance = _process(alpha)
    transition: Floats = exp(-u) * (u ** np.arange(alpha) @ powers).reshape(alpha, alpha)
    noise: Floats = covariance - transition @ covariance @ transition.T
    return transition, noise


def stationary(alpha: int) -> Floats:
    """Stationary covariance P (alpha, alpha) of the process of sd 1 and its scaled derivatives."""
    return _process(alpha)[1]


@cache
def _process(alpha: int) -> tuple[Floats, Floats]:
    """Matrices N^j / j! for j < alpha, as rows (alpha, alpha^2), and the stationary covariance P (alpha, alpha)."""
    companion = np.eye(alpha, k=1)
    companion[-1] = [-comb(alpha, k) for k in range(alpha)]
    noise = np.zeros((alpha, alpha))
    noise[-1, -1] = 1.0
    covariance: Floats = solve_continuous_lyapunov(companion, -noise)
    shift = companion + np.eye(alpha)
    powers = np.array([np.linalg.matrix_power(shift, j).ravel() / factorial(j) for j in range(alpha)])
    return powers, 0.5 * (covariance + covariance.T) / covariance[0, 0]

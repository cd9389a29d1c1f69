"""Fit the noise of a residual: white noise plus an Ornstein-Uhlenbeck process, at a cost O(n) in the record's length.

The correlation time is at most 1/50 of the record: a slower variation is not noise but an effect that the model lacks.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from estimator.model.linear_gaussian import Factor
from estimator.model.ornstein_uhlenbeck import Chain
from estimator.signals import Floats

MAX_MEMORY_SHARE = 1 / 50  # of the record's duration
MIN_SD_SHARE = 1e-3  # of the residual's rms: with less noise, products would cancel to rounding errors
STARTS = (0.05, 0.5)  # of the range of log memory: starts of the search for the scales


@dataclass(frozen=True)
class Scales:
    """Standard deviations of the white and of the slow (Ornstein-Uhlenbeck) part, in the residual's unit.

    ``memory``: correlation time [s] of the slow part.
    """

    white: float
    slow: float
    memory: float

    @property
    def variance(self) -> float:
        """Variance of one sample."""
        return self.white**2 + self.slow**2


class Noise:
    """Noise at ascending times ``t`` [s] (n,), with covariance K (n, n)."""

    def __init__(self, t: Floats, scales: Scales) -> None:
        self._chain = Chain(t, np.arange(len(t)), np.ones(len(t) - 1, dtype=bool))
        self._scales = scales
        precision = np.zeros((2, len(t)))
        log_prior = self._chain.add_precision(precision, scales.slow, scales.memory)
        precision[0] += scales.white**-2.0
        self._factor = Factor.of(precision)
        white = 2 * len(t) * float(np.log(scales.white))
        self.log_determinant = white + self._factor.log_determinant - log_prior

    def gram(self, columns: Floats) -> Floats:
        """Products Y' K^-1 Y (c, c) of columns (n, c), by the Woodbury identity."""
        scaled = columns / self._scales.white
        inner = self._factor.whiten(scaled / self._scales.white)
        products: Floats = scaled.T @ scaled - inner.T @ inner
        return products

    def draw(self, rng: np.random.Generator) -> Floats:
        """Draw one record (n,) of the noise."""
        precision = np.zeros((2, len(self._chain.t)))
        self._chain.add_precision(precision, self._scales.slow, self._scales.memory)
        normal = rng.standard_normal((len(self._chain.t), 2))
        slow: Floats = Factor.of(precision).unwhiten(normal[:, :1])[:, 0]
        return slow + self._scales.white * normal[:, 1]


def fit_noise(t: Floats, rms: float, log_evidence: Callable[[Noise], float]) -> Scales:
    """Fit the scales by maximum marginal likelihood.

    Parameters
    ----------
    t
        Times [s] (n,).
    rms
        Root mean square of the residual; bounds the scales.
    log_evidence
        Log evidence of the data under a noise, with its log determinant.
    """
    step = float(np.median(np.diff(t)))
    shortest, longest = 0.5 * step, max(MAX_MEMORY_SHARE * float(t[-1] - t[0]), step)
    sds = (np.log(MIN_SD_SHARE * rms), np.log(2 * rms))
    bounds = [sds, sds, (np.log(shortest), np.log(longest))]

    def scales(x: Floats) -> Scales:
        return Scales(*np.exp(x).tolist())

    def loss(x: Floats) -> float:
        return -log_evidence(Noise(t, scales(x)))

    best: tuple[float, Floats] | None = None
    for start in STARTS:
        memory = bounds[2][0] + start * (bounds[2][1] - bounds[2][0])
        first = np.array([np.log(0.5 * rms), np.log(0.3 * rms), memory])
        optimum = minimize(loss, first, method="L-BFGS-B", bounds=bounds)
        if best is None or optimum.fun < best[0]:
            best = float(optimum.fun), optimum.x
    assert best is not None
    return scales(best[1])

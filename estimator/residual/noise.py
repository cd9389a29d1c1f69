"""Noise of a residual: white, plus a part with a memory (Ornstein-Uhlenbeck); O(n) in the length of the record.

The memory is at most a fiftieth of the record: what wanders more slowly is no noise, but something the model lacks.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from estimator.model.linear_gaussian import Factor
from estimator.model.ornstein_uhlenbeck import Chain
from estimator.signals import Floats

MAX_MEMORY_SHARE = 1 / 50  # of the record's duration
MIN_SD_SHARE = 1e-3  # of the residual's rms: less noise is rounding, and the products would cancel
STARTS = (0.05, 0.5)  # of the range of log memory, at which the search for the scales begins


@dataclass(frozen=True)
class Scales:
    """Standard deviations of the white part and of the part with a memory, in the residual's unit; memory [s]."""

    white: float
    slow: float
    memory: float

    @property
    def variance(self) -> float:
        """Of one sample."""
        return self.white**2 + self.slow**2


class Noise:
    """The noise at times ``t`` [s] (n,), ascending; K is its covariance."""

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
        """One record (n,) of the noise."""
        precision = np.zeros((2, len(self._chain.t)))
        self._chain.add_precision(precision, self._scales.slow, self._scales.memory)
        normal = rng.standard_normal((len(self._chain.t), 2))
        slow: Floats = Factor.of(precision).unwhiten(normal[:, :1])[:, 0]
        return slow + self._scales.white * normal[:, 1]


def fit_noise(t: Floats, rms: float, log_evidence: Callable[[Noise], float]) -> Scales:
    """The scales of largest marginal likelihood.

    Parameters
    ----------
    t
        Times [s] (n,).
    rms
        Of the residual: bounds the scales.
    log_evidence
        Of the data under a noise, its determinant counted.
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
        found = minimize(loss, first, method="L-BFGS-B", bounds=bounds)
        if best is None or found.fun < best[0]:
            best = float(found.fun), found.x
    assert best is not None
    return scales(best[1])

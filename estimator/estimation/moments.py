"""The fit behind the posterior: moments that noise in the regressors does not bias.

Model: P = X theta + e with columns X = [v, v^3, v a, -dP] and theta = [A, C, m, tau]; tau [s] is what is left of
the lag between power and speed, to first order. Noise of the wheel speed sits in X, so least squares is biased
towards a light vehicle with more friction. The instruments Z are the same columns from readings that surround the
sample without touching it; their noise is independent of the sample's, so

    Z' (P - X theta) = 0

estimates theta without knowing how noisy the sensors are. Which samples count is decided by the model power that
the *instruments* predict: choosing by the measured power would choose by its noise.

The covariance of the moments has to allow for residuals that stay on one side for seconds. It is the average of
the lowest B cosine transforms of Z e (equal-weighted cosines: Mueller 2004; Lazarus, Lewis, Stock, Watson 2018),
which makes the estimate t-distributed with B degrees of freedom.
"""

from dataclasses import dataclass

import numpy as np
from scipy.fft import dct, irfft, next_fast_len, rfft

from estimator.road_load import design
from estimator.samples import Samples
from estimator.signals import Floats, Mask

SELECTIONS = 8  # passes that settle which samples count
FEWEST_COSINES = 8
TIMES_PER_COSINE = 4.0  # autocorrelation times that one cosine transform must span


@dataclass(frozen=True)
class Fit:
    """Result of the moment fit; parameters in the order A [N], C [N s^2/m^2], m [kg], tau [s]."""

    theta: Floats
    covariance: Floats
    dof: float
    kept: Mask  # samples that count
    rms: float  # [W] residual
    effective: float  # number of independent residuals

    @property
    def sd(self) -> Floats:
        """Standard deviation of each parameter (p,)."""
        return np.sqrt(np.diag(self.covariance))


def autocorrelation_time(x: Floats) -> float:
    """Integrated autocorrelation time [samples], at least 1, with Sokal's window of 5 times itself."""
    n = len(x)
    size = next_fast_len(2 * n)
    spectrum = rfft(x - x.mean(), size)
    covariance = irfft(np.abs(spectrum) ** 2, size)[:n]
    if covariance[0] <= 0:
        return 1.0
    tau = 2 * np.cumsum(covariance / covariance[0]) - 1
    enough = np.flatnonzero(np.arange(n) >= 5 * tau)
    return max(float(tau[enough[0]] if len(enough) else tau[-1]), 1.0)


def long_run_covariance(scores: Floats, cosines: int) -> Floats:
    """Covariance (p, p) of the column sums of ``scores`` (n, p), autocorrelated as they may be."""
    transform = dct(scores, type=2, axis=0, norm="ortho")[1 : cosines + 1]
    return len(scores) * transform.T @ transform / len(transform)


def columns(samples: Samples) -> tuple[Floats, Floats]:
    """Regressors X and instruments Z, both (n, 4)."""
    X = np.column_stack([design(samples.v, samples.a), -samples.dP])
    Z = np.column_stack([design(samples.zv, samples.za), -samples.zdP])
    return X, Z


def fit(samples: Samples, power_sigmas: float) -> Fit | None:
    """Fit all samples whose predicted power exceeds ``power_sigmas`` residual sd.

    Returns None where the moments do not determine the parameters: too few samples, or a drive so uniform that the
    columns are not independent.
    """
    X, Z = columns(samples)
    p = X.shape[1]
    # Columns of order one: v^3 is 10^4 times v, and the equations would look singular for that alone.
    scale = np.sqrt(np.mean(X**2, axis=0)) if len(X) else np.ones(p)
    if not np.all(scale > 0):
        return None
    X, Z = X / scale, Z / scale
    kept = np.ones(len(X), dtype=bool)
    theta, sd, previous = np.zeros(p), 0.0, kept
    for _ in range(SELECTIONS):
        if kept.sum() < 10 * p:
            return None
        cross = Z[kept].T @ X[kept] / kept.sum()
        if np.linalg.cond(cross) > 1 / np.sqrt(np.finfo(float).eps):
            return None
        theta = np.linalg.solve(cross, Z[kept].T @ samples.P[kept] / kept.sum())
        residual = samples.P[kept] - X[kept] @ theta
        sd = float(residual.std())
        previous, kept = kept, Z[:, :3] @ theta[:3] > power_sigmas * sd
        if np.array_equal(kept, previous):
            break
    kept = previous
    n = int(kept.sum())
    time = autocorrelation_time(residual)
    cosines = int(np.clip(n / (TIMES_PER_COSINE * time), FEWEST_COSINES, 0.4 * n ** (2 / 3)))
    spread = long_run_covariance(Z[kept] * residual[:, None], cosines)
    inverse = np.linalg.inv(Z[kept].T @ X[kept])
    covariance = inverse @ spread @ inverse.T / np.outer(scale, scale)
    return Fit(theta / scale, covariance, float(cosines), kept, float(np.sqrt(np.mean(residual**2))), n / time)

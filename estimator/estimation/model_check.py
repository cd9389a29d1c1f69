"""Can the model describe the data at all: a posterior-predictive check of the residual.

If the model holds, the residual P - X theta has no mean left in any part of the drive, whatever its noise. The
check splits the samples by the speed, the acceleration and the power that their *instruments* give, which share no
noise with the residual, and asks of each part whether its mean residual is both certain and large: certain against
the spread that autocorrelated residuals of this size have, large against the power itself. A long drive makes every
small imperfection certain; only large ones make an estimate worthless.
"""

import numpy as np

from estimator.estimation.moments import ROAD_LOAD, Fit, columns
from estimator.samples import Samples
from estimator.signals import Floats

PARTS = 8  # quantile bins along each axis
CERTAIN = 5.0  # standard errors
LARGE = 0.15  # of the mean model power
LEAST_EXPLAINED = 0.5  # share of the variance of power


def misfit(samples: Samples, fit: Fit) -> str:
    """Empty when the fitted model describes ``samples``, else what it misses."""
    kept = samples[fit.kept]
    X, Z = columns(kept)
    residual = kept.P - X @ fit.theta
    explained = 1 - float(residual.var() / kept.P.var())
    if explained < LEAST_EXPLAINED:
        share = 100 * max(explained, 0.0)
        return f"the model explains {share:.0f} % of the power's variance: grade, or a wrong signal?"
    model = Z[:, :ROAD_LOAD] @ fit.theta[:ROAD_LOAD]
    # One residual counts for as much less as there are correlated ones around it.
    inflation = len(residual) / fit.effective
    axes = (("speed", "m/s", kept.zv), ("acceleration", "m/s²", kept.za), ("model power", "kW", model / 1e3))
    worst, found = 0.0, ""
    for name, unit, axis in axes:
        edges = np.quantile(axis, np.linspace(0, 1, PARTS + 1))
        part = np.clip(np.searchsorted(edges, axis, side="right") - 1, 0, PARTS - 1)
        for k in range(PARTS):
            share, z = _bias(residual[part == k], float(model.mean()), inflation)
            if abs(z) > CERTAIN and abs(share) > max(LARGE, abs(worst)):
                worst = share
                place = f"{name} {edges[k]:.3g}..{edges[k + 1]:.3g} {unit}"
                found = f"{100 * share:+.0f} % of the mean power is left at {place}"
    return found


def _bias(residual: Floats, power: float, inflation: float) -> tuple[float, float]:
    """Mean residual as a share of ``power`` [W], and in standard errors."""
    if len(residual) < 2:
        return 0.0, 0.0
    mean = float(residual.mean())
    error = float(residual.std()) * np.sqrt(inflation / len(residual))
    return mean / power, mean / error if error > 0 else 0.0

"""The lag between power and speed: control units send what they measured at different delays.

Power moved by the right lag fits the road load best, so the lag is found by moving it.
"""

import numpy as np

from estimator.model.road_load import design
from estimator.preparation.smoothing import convolve, smoother_kernels
from estimator.signals import Floats

LONGEST_LAG = 2.0  # s
RATIO = 100.0  # 1/s^4, of the smoother used here
SLOWEST = 2.0  # m/s
FEWEST = 300  # samples
CORRELATION = 1.0  # s, over which residuals are taken to hang together
SURE = 0.1  # s, standard deviation beyond which a lag is not believed


def fit_lag(speed: Floats, power: Floats, dt: float, longest: float) -> float:
    """Delay of power behind speed [s] that makes the road-load model fit best; 0 when the data cannot tell.

    Parabola through the smallest residual sums of least squares over shifts of up to ``longest`` [s] either way;
    how sharp it is says how sure the lag is.
    ``speed`` (n,) [m/s] and ``power`` (n,) [W] on a grid of step ``dt`` [s], NaN where unknown.
    """
    kernels = smoother_kernels(RATIO, dt)
    v, a, P = convolve(speed, kernels.value), convolve(speed, kernels.slope), convolve(power, kernels.value)
    reach = round(longest / dt) + 1
    known = np.isfinite(v) & np.isfinite(a) & (v > SLOWEST)
    shifts = range(-reach, reach + 1)
    shifted = np.stack([np.roll(P, -k) for k in shifts])
    known[:reach] = known[len(known) - reach :] = False
    # Brakes and gear changes, which the model does not know, would pull the lag: keep to steady traction.
    known &= (shifted > 0).all(axis=0)
    if known.sum() < FEWEST:
        return 0.0
    X = design(v[known], a[known])
    y = shifted[:, known].T
    residual = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
    total = ((y - y.mean(axis=0)) ** 2).sum(axis=0)
    if not np.all(total > 0):
        return 0.0
    # Shifts change how much power there is to explain, so compare shares, not sums.
    share = (residual**2).sum(axis=0) / total
    best = int(np.argmin(share))
    if best in (0, 2 * reach):
        return 0.0
    left, centre, right = share[best - 1 : best + 2]
    bend = left - 2 * centre + right
    independent = known.sum() * dt / CORRELATION
    if bend <= 0 or centre * dt**2 > independent * bend * SURE**2:
        return 0.0
    offset = 0.5 * (left - right) / bend
    return float(np.clip((best - reach + offset) * dt, -longest, longest))

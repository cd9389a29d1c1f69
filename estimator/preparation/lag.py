"""The lag between power and speed: control units send their measurements with different delays.

The lag is the shift of power with which the road load fits best.
"""

import numpy as np

from estimator.model.road_load import design
from estimator.preparation.smoothing import convolve, smoother_kernels
from estimator.signals import Floats

MAX_LAG = 2.0  # s, largest value of `kinematics.maximum_lag_s`
SMOOTHER_RATIO = 100.0  # 1/s^4, of the smoother used here: geometric mean of `smoothing.RATIO_BOUNDS`
MIN_SPEED = 2.0  # m/s, chosen by hand: with 1 and 4 m/s three flat drives give the same within 0.01 sd
MIN_SAMPLES = 300  # 30 s at 10 Hz: with CORRELATION, 30 independent residuals for 3 coefficients and the lag
CORRELATION = 1.0  # s, correlation time of the residuals
MAX_LAG_SD = 0.1  # s: a lag with a larger standard deviation counts as unknown


def fit_lag(speed: Floats, power: Floats, dt: float, longest: float) -> float:
    """Delay of power behind speed [s] with which the road-load model fits best; 0 where its sd is above MAX_LAG_SD.

    The minimum of a parabola through the smallest residual sums of least squares, over shifts of up to ``longest`` [s]
    either way; its curvature gives the sd. ``speed`` (n,) [m/s] and ``power`` (n,) [W] are on a grid of step ``dt``
    [s], NaN where unknown.
    """
    kernels = smoother_kernels(SMOOTHER_RATIO, dt)
    v, a, P = convolve(speed, kernels.value), convolve(speed, kernels.slope), convolve(power, kernels.value)
    reach = round(longest / dt) + 1
    known = np.isfinite(v) & np.isfinite(a) & (v > MIN_SPEED)
    shifts = range(-reach, reach + 1)
    shifted = np.stack([np.roll(P, -k) for k in shifts])
    known[:reach] = known[len(known) - reach :] = False
    # The model has no brakes and gear changes, which would bias the lag: keep to steady traction.
    known &= (shifted > 0).all(axis=0)
    if known.sum() < MIN_SAMPLES:
        return 0.0
    X = design(v[known], a[known])
    y = shifted[:, known].T
    residual = y - X @ np.linalg.lstsq(X, y, rcond=None)[0]
    total = ((y - y.mean(axis=0)) ** 2).sum(axis=0)
    if not np.all(total > 0):
        return 0.0
    # A shift changes the variance of the power, so compare shares of it, not sums.
    share = (residual**2).sum(axis=0) / total
    best = int(np.argmin(share))
    if best in (0, 2 * reach):
        return 0.0
    left, centre, right = share[best - 1 : best + 2]
    bend = left - 2 * centre + right
    independent = known.sum() * dt / CORRELATION
    if bend <= 0 or centre * dt**2 > independent * bend * MAX_LAG_SD**2:
        return 0.0
    offset = 0.5 * (left - right) / bend
    return float(np.clip((best - reach + offset) * dt, -longest, longest))

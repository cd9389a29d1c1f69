"""Low-pass and derivative of noisy signals on a uniform time grid, by convolution.

The smoother is the Rauch-Tung-Striebel smoother of the constant-acceleration Kalman model

    v' = a,  a' = white jerk of intensity q [m^2/s^5];  measured: v + white noise of variance r [m^2/s^2]

whose steady state is a linear, symmetric filter that depends on q / r alone. Its impulse response, taken from
filterpy once, is a kernel of finite width: it can be applied to live traffic with a fixed lag, to a whole log at
once, and to any other signal (power, grade), so that one and the same low-pass acts on both sides of the model.

Noise of the wheel speed enters the regressors of the model, where it would bias the estimate (errors in
variables). `instrument_kernels` gives speed and acceleration a second time, from a ring of samples around the
moment that leaves out its surroundings, so that their noise is independent of the smoothed values.

References: Rauch, Tung, Striebel 1965; Bar-Shalom, Li, Kirubarajan 2001, section 6.2.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar

from estimator.checkpoint.validation import State, array, table
from estimator.lean_import import import_deferring
from estimator.preparation.recursion import recursive
from estimator.samples import STEP
from estimator.signals import Floats

HALF_WIDTH = 1.2  # s, of the smoother's kernel; shorter than HOLE, which keeps instruments independent
HOLE = 1.5  # s, half width of the surroundings that instruments leave out
REACH = 4.0  # s, half width of the ring they are fitted to
DERIVATIVE = np.array([-1.0, 8.0, 0.0, -8.0, 1.0]) / 12.0  # five-point central difference, as a kernel for steps of 1
WARM_UP = 8.0  # s of filtering before the impulse: the Kalman gain is steady by then
RATIO_BOUNDS = (10.0, 1000.0)  # 1/s^4, q / (r dt): memories of about 0.6 to 0.2 s


@dataclass(frozen=True)
class Kernels:
    """Symmetric `value` and antisymmetric `slope` weights (2 K + 1,) for steps of dt: signal and its derivative."""

    value: Floats
    slope: Floats

    @property
    def half(self) -> int:
        """K, the samples needed on either side."""
        return len(self.value) // 2

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads."""
        return table(self)

    @classmethod
    def restore(cls, state: State) -> "Kernels":
        """A smoother's kernels from their state.

        Raises
        ------
        StateError
            They are not as wide as a smoother on the grid has them.
        """
        width = (2 * round(HALF_WIDTH / STEP) + 1,)
        return cls(array(state, "value", width), array(state, "slope", width))


def _model(ratio: float, dt: float) -> Any:
    """Constant-acceleration filter with r = 1 / dt and q = ratio: the gain depends on their ratio only."""
    kalman = import_deferring("filterpy.stats", "filterpy.kalman").KalmanFilter(dim_x=2, dim_z=1)
    kalman.F = np.array([[1.0, dt], [0.0, 1.0]])
    kalman.H = np.array([[1.0, 0.0]])
    kalman.Q = ratio * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    kalman.R = np.array([[1.0 / dt]])
    kalman.P = np.diag([1.0 / dt, ratio])
    return kalman


@lru_cache(maxsize=64)
def smoother_kernels(ratio: float, dt: float) -> Kernels:
    """Impulse response of the RTS smoother.

    Parameters
    ----------
    ratio
        q / (r dt) [1/s^4]: jerk intensity over the spectral density of the speed noise.
    dt
        Grid step [s].
    """
    kalman = _model(ratio, dt)
    centre = round(WARM_UP / dt)
    impulse = np.zeros((2 * centre + 1, 1))
    impulse[centre] = 1.0
    means, covariances, _, _ = kalman.batch_filter(impulse)
    smoothed = kalman.rts_smoother(means, covariances)[0].reshape(-1, 2)
    half = round(HALF_WIDTH / dt) - len(DERIVATIVE) // 2
    # The value at step k answers the impulse at lag k; a kernel for np.convolve runs the same way round.
    window = smoothed[centre - half : centre + half + 1, 0]
    value = (window + window[::-1]) / 2
    value /= value.sum()  # a constant stays the same although the tails are cut
    # The slope is the derivative of the value, to fourth order in dt: speed and power pass the same low-pass. The
    # smoother's own acceleration does so only before its tails are cut; after, m came out 0.02-0.1 % high.
    return Kernels(np.pad(value, len(DERIVATIVE) // 2), np.convolve(value, DERIVATIVE / dt))


@lru_cache(maxsize=8)
def instrument_kernels(dt: float) -> Kernels:
    """Value and slope at the centre of a cubic fitted to the ring HOLE < |lag| <= REACH [s]."""
    half = round(REACH / dt)
    lags = np.arange(-half, half + 1) * dt
    ring = np.abs(lags) > HOLE
    cubic = np.linalg.pinv(np.vander(lags[ring], 4, increasing=True))
    value, slope = np.zeros(2 * half + 1), np.zeros(2 * half + 1)
    value[ring], slope[ring] = cubic[0], cubic[1]
    return Kernels(value[::-1], slope[::-1])


@lru_cache(maxsize=8)
def slow_kernel(dt: float) -> Floats:
    """Weights (2 K + 1,) of a raised-cosine low-pass as wide as the ring, for gravity along the grade."""
    half = round(REACH / dt)
    weights = 1 + np.cos(np.pi * np.arange(-half, half + 1) / (half + 1))
    kernel: Floats = weights / weights.sum()
    return kernel


def convolve(signal: Floats, kernel: Floats) -> Floats:
    """``signal`` (n,) through a ``kernel`` (2 K + 1,): (n,), NaN in the first and last K values and near gaps."""
    half = len(kernel) // 2
    out = np.full(len(signal), np.nan)
    if len(signal) >= len(kernel):
        out[half : len(signal) - half] = np.convolve(signal, kernel, mode="valid")
    return out


def fit_ratio(speed: Floats, dt: float) -> float:
    """Maximum-likelihood q / (r dt) [1/s^4] of the constant-acceleration model, from its innovations.

    ``speed`` (n,) [m/s] on a grid of step ``dt`` [s]; NaN where unknown. The scale of the innovations is
    concentrated out of the likelihood, so only the ratio is searched. The result stays inside RATIO_BOUNDS: a
    smoother with a longer memory would leak into the instruments' hole.
    """
    known = np.isfinite(speed)
    pieces = [piece for piece in np.split(speed, np.flatnonzero(~known)) if np.isfinite(piece[1:]).sum() > 4 / dt]
    pieces = [piece[np.isfinite(piece)] for piece in pieces]
    if not pieces:
        return float(np.sqrt(RATIO_BOUNDS[0] * RATIO_BOUNDS[1]))

    def cost(log_ratio: float) -> float:
        kalman = _model(float(np.exp(log_ratio)), dt)
        for _ in range(round(WARM_UP / dt)):  # to the steady gain
            kalman.predict()
            kalman.update(np.zeros(1))
        g, h = kalman.K[:, 0]
        # Innovation of the steady filter as an ARMA recursion on the measured speed.
        recursion = np.array([1.0, g + h * dt - 2.0, 1.0 - g])
        squares, count = 0.0, 0
        for piece in pieces:
            e = recursive(np.diff(piece - piece[0], 2, prepend=[0.0, 0.0]), recursion)[2:]
            squares, count = squares + float(e @ e), count + len(e)
        return count * float(np.log(max(squares / count, np.finfo(float).tiny)))

    low, high = np.log(RATIO_BOUNDS)
    return float(np.exp(minimize_scalar(cost, bounds=(low, high), method="bounded", options={"xatol": 0.05}).x))

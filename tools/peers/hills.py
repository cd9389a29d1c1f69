"""Three online estimators of the mass over roads whose slope is unknown, on the same rows and masks as roadload.

Force at the wheels F = P / v drives m dv/dt = F - A - C v^2 - m g theta; m [kg], v [m/s], P [W], theta the sine of the
slope. A and C are told to an estimator that needs them.

`two_forgetting_factors` is the recursion of Vahidi, Stefanopoulou, Peng, Vehicle System Dynamics 43 (2005) 31-55:
acceleration on force, where 1/m and the slope have forgetting factors and gains of their own.

`kalman_with_slope` is an extended Kalman filter of v, m and theta, whose noise lets it vary while it returns to zero
(Lingman & Schmidtbauer, Vehicle System Dynamics Supplement 37 (2002) 12-23, estimate mass and slope alike). The filter
is filterpy's.

`band_passed` regresses force on acceleration behind one band-pass, between the slopes and the sensors' noise (Fathy,
Kang, Stein, "Online vehicle mass estimation using recursive least squares and supervisory data extraction", American
Control Conference 2008, separate fast from slow forces alike).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import butter, lfilter

from estimator.samples import STEP
from estimator.signals import Floats
from estimator.units import STANDARD_GRAVITY
from peers.level import FORCE_NOISE, MIN_STATE, START, START_SD, Normal, SpeedFilter, Stretch, pass_all, regression

SLOPE_SD = 0.02  # of the slope's sine at the start
SLOPE_TIME = 30.0  # s in which the slope of the filter returns to zero
INVERSE_MASS_SD = 3e-5  # 1/kg, at the start
MIN_INVERSE_MASS, MIN_MASS = 1e-6, 1e3  # 1/kg, kg


@dataclass(frozen=True)
class Known:
    """What is told of the vehicle: ``A`` [N] and ``C`` [N s^2/m^2]."""

    A: float
    C: float


@dataclass(frozen=True)
class TwoFactors:
    """Settings of the recursion: forgetting factors per row [1] of 1/m and of the slope, ``cutoff`` [Hz]."""

    mass: float
    slope: float
    cutoff: float


@dataclass(frozen=True)
class SlopeNoise:
    """Settings of the filter: white noise on ``power`` [W], sd of the ``slope`` [1], noise on ``speed`` [m/s]."""

    power: float
    slope: float
    speed: float


@dataclass(frozen=True)
class Band:
    """Corner frequencies of the band-pass [Hz]."""

    low: float
    high: float


def two_forgetting_factors(data: Sequence[Stretch], settings: TwoFactors, known: Known) -> Normal:
    """Recursion over all rows in order; the slope takes up the rolling resistance, and C is known."""
    steps = list(_recursion(data, settings, known))
    _, theta, spread, _ = steps[-1]
    mass, squares = 1 / max(float(theta[0]), MIN_INVERSE_MASS), sum(step[3] for step in steps)
    return Normal(mass, float(np.sqrt(squares / max(len(steps) - 2, 1) * spread[0])) * mass**2)


def slopes_by_two_factors(data: Sequence[Stretch], settings: TwoFactors, known: Known) -> Floats:
    """Times [s] and sine of the slope [1] (n, 2) by the same recursion, row by row; A is known as well."""
    found = [
        (t, theta[1] - known.A * max(theta[0], MIN_INVERSE_MASS) / STANDARD_GRAVITY)
        for t, theta, _, _ in _recursion(data, settings, known)
    ]
    return np.array(found).reshape(-1, 2)


def _recursion(
    data: Sequence[Stretch], settings: TwoFactors, known: Known
) -> Iterator[tuple[float, Floats, Floats, float]]:
    """After each row its time [s], 1/m and slope (2,), their relative variances (2,), and the squared innovation."""
    theta = np.array([1 / START[2], 0.0])
    spread = np.array([INVERSE_MASS_SD**2, SLOPE_SD**2]) / (FORCE_NOISE / START[2]) ** 2
    factors = np.array([settings.mass, settings.slope])
    for stretch in data:
        columns, force = regression(stretch, settings.cutoff)
        regressors = np.column_stack([force - known.C * columns[:, 1], -STANDARD_GRAVITY * columns[:, 0]])
        for t, x, a in zip(stretch.t[1:].tolist(), regressors, columns[:, 2], strict=True):
            share = spread * x**2 / factors
            innovation = a - x @ theta
            theta = theta + spread * x / factors * (innovation / (1 + share.sum()))
            spread = spread / factors / (1 + share)
            yield t, theta, spread, float(innovation**2 / (1 + share.sum()))


class SlopeFilter(SpeedFilter):
    """Filter of the states v [m/s], m [kg] and the sine of the slope [1]; input: power [W]."""

    def __init__(self, settings: SlopeNoise, known: Known) -> None:
        start, sd = np.array([0.0, START[2], 0.0]), np.array([0.0, START_SD[2], SLOPE_SD])
        super().__init__(start, sd, np.array([MIN_STATE[0], MIN_MASS, -np.inf]), settings.speed)
        self._known, self._power_noise = known, settings.power
        self._keep = float(np.exp(-STEP / SLOPE_TIME))
        self._slope_noise = settings.slope**2 * (1 - self._keep**2)

    def begin(self, speed: float) -> None:
        """Start a stretch at a measured ``speed`` [m/s], on an unknown slope."""
        self.x[0], self.x[2] = speed, 0.0
        self.P[[0, 2], :] = 0.0
        self.P[:, [0, 2]] = 0.0
        self.P[0, 0], self.P[2, 2] = self.R[0, 0], SLOPE_SD**2

    def predict_x(self, u: float = 0.0) -> None:
        """Equation of motion over one row with power ``u`` [W]; sets its Jacobian and noise for the covariance."""
        v, m, slope = self.x
        driving = u / v - self._known.A - self._known.C * v**2
        self.F = np.eye(3)
        self.F[0] += STEP * np.array([-(u / v**2 + 2 * self._known.C * v) / m, -driving / m**2, -STANDARD_GRAVITY])
        self.F[2, 2] = self._keep
        self.Q = np.diag([(self._power_noise * STEP / (m * v)) ** 2, 0.0, self._slope_noise])
        self.x = np.array([v + STEP * (driving / m - STANDARD_GRAVITY * slope), m, self._keep * slope])


def kalman_with_slope(data: Sequence[Stretch], settings: SlopeNoise, known: Known) -> Normal:
    """Filter over all rows in order; A and C are known."""
    kalman = SlopeFilter(settings, known)
    pass_all(kalman, data)
    return Normal(float(kalman.x[1]), float(np.sqrt(kalman.P[1, 1])))


def band_passed(data: Sequence[Stretch], settings: Band, known: Known) -> Normal:
    """Least squares over all rows but those at the start of a stretch, in which the band-pass settles; C is known."""
    settling = round(1 / settings.low / STEP)
    band = butter(2, (settings.low, settings.high), "bandpass", fs=1 / STEP)
    aa, aF, FF, count = 0.0, 0.0, 0.0, 0
    for stretch in data:
        columns = _motion(stretch, known)
        a, F = lfilter(*band, columns - columns[0], axis=0)[settling:].T
        aa, aF, FF, count = aa + float(a @ a), aF + float(a @ F), FF + float(F @ F), count + len(a)
    mass = aF / max(aa, 1e-12)
    return Normal(mass, float(np.sqrt(max(FF - mass * aF, 0.0) / max(count - 1, 1) / max(aa, 1e-12))))


def _motion(stretch: Stretch, known: Known) -> Floats:
    """Acceleration [m/s^2] and force less drag [N] (n - 1, 2), between two rows."""
    v = stretch.speed
    between = (v[1:] + v[:-1]) / 2
    force = (stretch.power[1:] + stretch.power[:-1]) / 2 / between - known.C * between**2
    return np.column_stack([np.diff(v) / STEP, force])

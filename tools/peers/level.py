"""Two online estimators of A, C, m from the literature, on the same rows and masks as roadload.

Force at the wheels F = P / v is modelled as F = A + C v^2 + m dv/dt; A [N], C [N s^2/m^2], m [kg], v [m/s], P [W].

`recursive_least_squares` follows Vahidi, Stefanopoulou, Peng, "Recursive least squares with forgetting for online
estimation of vehicle mass and road grade", Vehicle System Dynamics 43 (2005) 31-55: mass and resistance have
forgetting factors of their own. Their gain treats the two as independent; here the whole covariance is kept, and the
part of each parameter grows at its own rate, D P D with D = diag(lambda^-1/2) (vector forgetting), because v^2 and 1
are correlated. Both sides of the equation pass one causal low-pass, so that its delay cancels.

`extended_kalman` has the states v, A, C, m, the latter three as random walks; F drives dv/dt = (F - A - C v^2) / m
and v is measured (Lingman & Schmidtbauer, Vehicle System Dynamics Supplement 37 (2002) 12-23, estimate mass and slope
alike). The filter is filterpy's.

Both need only the present row, a few states and a covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from harness.scores import Score
from scipy.signal import butter, lfilter

from estimator.preparation.admission import ADMITTED, row_reasons
from estimator.samples import STEP, Rows
from estimator.settings import Admission
from estimator.signals import Floats

START = np.array([1800.0, 4.0, 25e3])  # N, N s^2/m^2, kg: initial values for any class-8 truck
START_SD = np.array([1000.0, 2.0, 10e3])  # N, N s^2/m^2, kg
MIN_STATE = np.array([0.1, *START / 20])  # lowest v, A, C, m of the filter, which diverges below
HOUR = 3600.0  # s
MIN_ROWS = 20  # rows: stretches of less than 2 s are left out
FORCE_NOISE = 300.0  # N, weighs the start of the recursion against data
Z90 = 1.6449  # standard deviations to either end of a 90 % interval


@dataclass(frozen=True)
class Stretch:
    """Consecutive admitted rows: times ``t`` [s], ``speed`` [m/s] and ``power`` [W] at the wheels, all (n,)."""

    t: Floats
    speed: Floats
    power: Floats


@dataclass(frozen=True)
class Normal:
    """An estimate after the last row, with its standard deviation ``sd``, SI."""

    mean: float
    sd: float

    def score(self, truth: float) -> Score:
        """Compare with the ``truth``."""
        return Score(
            self.mean / truth - 1, self.sd / truth, abs(truth - self.mean) <= Z90 * self.sd, Z90 * self.sd / self.mean
        )


@dataclass(frozen=True)
class Forgetting:
    """Settings of the recursion: ``mass`` and ``resistance`` are forgetting factors per row [1], ``cutoff`` [Hz]."""

    mass: float
    resistance: float
    cutoff: float


@dataclass(frozen=True)
class ProcessNoise:
    """Settings of the filter.

    ``power`` [W] is the sd of white noise on a row's power, ``walk`` the relative sd that A, C, m gain in an hour
    and ``speed`` [m/s] the sd of measured speed.
    """

    power: float
    walk: float
    speed: float


def stretches(rows: Rows, admission: Admission, lag: float) -> list[Stretch]:
    """Admitted stretches of ``rows``, power taken ``lag`` [s] later."""
    power = np.interp(rows.t + lag, rows.t, rows.power)
    usable = (row_reasons(rows, admission) == ADMITTED) & np.isfinite(power)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], usable, [False]]))).reshape(-1, 2)
    return [Stretch(rows.t[i:j], rows.speed[i:j], power[i:j]) for i, j in edges if j - i >= MIN_ROWS]


def regression(stretch: Stretch, cutoff: float) -> tuple[Floats, Floats]:
    """Columns 1, v^2, dv/dt (n - 1, 3) and force (n - 1,) [N] behind a second-order Butterworth low-pass.

    All pass the same filter from a state of zero (the column of ones too): the equation holds from the first row on.
    Differences lie between two rows, so everything else is taken there as well.
    """
    v, power = stretch.speed, stretch.power
    between = (v[1:] + v[:-1]) / 2
    force = (power[1:] + power[:-1]) / 2 / between
    columns = np.column_stack([np.ones_like(between), between**2, np.diff(v) / STEP, force])
    filtered = lfilter(*butter(2, cutoff, fs=1 / STEP), columns, axis=0)
    return filtered[:, :3], filtered[:, 3]


def recursive_least_squares(data: Sequence[Stretch], settings: Forgetting) -> dict[str, Normal]:
    """Recursion over all rows in order; the covariance is that of white residuals with their own variance."""
    theta, P = START.copy(), np.diag((START_SD / FORCE_NOISE) ** 2)
    growth = np.array([settings.resistance, settings.resistance, settings.mass]) ** -0.5
    growth = np.outer(growth, growth)
    squares, count = 0.0, 0
    for stretch in data:
        for x, force in zip(*regression(stretch, settings.cutoff), strict=True):
            P = P * growth
            Px = P @ x
            spread = 1.0 + x @ Px
            innovation = force - x @ theta
            theta = theta + Px * (innovation / spread)
            P = P - np.outer(Px, Px) / spread
            squares += innovation**2 / spread
            count += 1
    return _by_name(theta, np.sqrt(squares / max(count - 3, 1) * np.diag(P)))


class SpeedFilter(ExtendedKalmanFilter):  # type: ignore[misc]  # filterpy has no types
    """Extended Kalman filter of a speed [m/s], which is measured with a ``noise`` [m/s], and other states.

    They begin at ``start`` (n,) with standard deviations ``sd`` (n,), and are kept above ``lowest`` (n,).
    """

    def __init__(self, start: Floats, sd: Floats, lowest: Floats, noise: float) -> None:
        super().__init__(dim_x=len(start), dim_z=1)
        self.x, self.P, self.R = start, np.diag(sd**2), np.array([[noise**2]])
        self._lowest = lowest

    def see(self, speed: float) -> None:
        """Take a measured ``speed`` [m/s]."""
        self.update(np.array([speed]), lambda x: np.eye(1, len(x)), lambda x: x[:1])
        self.x = np.maximum(self.x, self._lowest)


class RoadLoadFilter(SpeedFilter):
    """Filter of the states v [m/s], A [N], C [N s^2/m^2], m [kg]; input: power [W]."""

    def __init__(self, settings: ProcessNoise) -> None:
        start, sd = (np.concatenate([[0.0], x]) for x in (START, START_SD))
        super().__init__(start, sd, MIN_STATE, settings.speed)
        self._power_noise = settings.power
        self._walk = (settings.walk * START) ** 2 * STEP / HOUR

    def begin(self, speed: float) -> None:
        """Start a stretch at a measured ``speed`` [m/s]: the force since the last one is unknown."""
        self.x[0] = speed
        self.P[0, :] = self.P[:, 0] = 0.0
        self.P[0, 0] = self.R[0, 0]

    def predict_x(self, u: float = 0.0) -> None:
        """Equation of motion over one row with power ``u`` [W]; sets its Jacobian and noise for the covariance."""
        start, A, C, m = self.x
        v = start + STEP / 2 * (u / start - A - C * start**2) / m  # halfway, where power is taken
        a = (u / v - A - C * v**2) / m
        self.F = np.eye(4)
        self.F[0] += STEP / m * np.array([-u / v**2 - 2 * C * v, -1.0, -(v**2), -a])
        self.Q = np.diag(np.concatenate([[(self._power_noise * STEP / (m * v)) ** 2], self._walk]))
        self.x = np.array([start + STEP * a, A, C, m])


def extended_kalman(data: Sequence[Stretch], settings: ProcessNoise) -> dict[str, Normal]:
    """Filter over all rows in order."""
    kalman = RoadLoadFilter(settings)
    pass_all(kalman, data)
    return _by_name(kalman.x[1:], np.sqrt(np.diag(kalman.P)[1:]))


def pass_all(kalman: Any, data: Sequence[Stretch]) -> None:
    """Take all rows in order: the power between two rows, then the speed of the second."""
    for stretch in data:
        kalman.begin(stretch.speed[0])
        between = (stretch.power[1:] + stretch.power[:-1]) / 2
        for speed, power in zip(stretch.speed[1:], between, strict=True):
            kalman.predict(power)
            kalman.see(speed)


def _by_name(theta: Floats, sd: Floats) -> dict[str, Normal]:
    """Estimates of A, C, m (3,) by their names."""
    return {name: Normal(float(x), float(s)) for name, x, s in zip(("A", "C", "mass"), theta, sd, strict=True)}

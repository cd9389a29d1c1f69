"""Fit the plain model of a drive: the road load on a level road, by least squares of the power of its strides.

    P = A v + C v^3 + m v a + lag dP/dt + drag min(P, 0)

This is the paper's criterion on strides of one second. Its residual is the gap, which the budget splits into causes.
"""

import numpy as np

from estimator.components.term import Frame
from estimator.estimation.long_run import long_run_variance
from estimator.estimation.road_fit import RoadFit
from estimator.estimation.road_likelihood import LAG, PLAIN, ROAD_LOAD, columns
from estimator.signals import Floats
from estimator.strides import LAGS

MIN_DOF = 4.0  # of the Student density of a parameter: below, its variance is hardly defined
MAX_CONDITION = 3e3  # condition number of the columns, scaled to one: beyond, they are not independent


class PlainModel:
    """Least-squares fit of the power at the driven strides of a fit; it projects any power off its columns.

    Parameters
    ----------
    fit
        Fit of the road model: gives the strides whose force is known, and the lag of the power.
    is_aligned
        True if the power is shifted by that lag; otherwise it is as measured.

    Attributes
    ----------
    power : Floats
        Measured power [W] (n,).
    second : ndarray
        Indices (k,) of the later stride of each pair, over which means of 2 s are taken.
    """

    def __init__(self, fit: RoadFit, is_aligned: bool = True) -> None:
        s, lag = fit.strides, fit.scales.lag
        self.power: Floats
        if is_aligned:
            plain = columns(s, lag, (), fit.road_load)[:, 1:PLAIN]
            self.power = Frame.of(fit).force * s.speed
        else:
            plain = np.delete(columns(s, len(LAGS) // 2, (), fit.road_load)[:, 1:PLAIN], LAG - 1, axis=1)
            self.power = s.power
        X: Floats = np.column_stack([s.a, plain]) * s.speed[:, None]
        self._unit = np.sqrt((X**2).mean(axis=0)) + 1e-12
        self._columns = X / self._unit
        self._speed = s.speed
        follows = s.joined
        run = np.cumsum(~follows)
        position = np.arange(len(s)) - np.searchsorted(run, run)
        self.second = np.flatnonzero((position % 2 == 1) & follows)

    @property
    def is_determined(self) -> bool:
        """True if the columns of A, C and m are independent, with a condition number below MAX_CONDITION."""
        return bool(np.linalg.cond(self._columns[:, :ROAD_LOAD]) < MAX_CONDITION)

    def as_power(self, acceleration: Floats, masses: Floats) -> Floats:
        """Power -m v a [W] (n, d) for an acceleration a [m/s^2] (n,) or (n, d) of vehicles of ``masses`` [kg] (d,)."""
        power: Floats = -acceleration.reshape(len(self._speed), -1) * self._speed[:, None] * masses
        return power

    def residual(self, power: Floats) -> Floats:
        """Residual (k, ...) of ``power`` (n, ...) after its projection off the plain road load, as means over 2 s."""
        rest = power - self._columns @ np.linalg.lstsq(self._columns, power, rcond=None)[0]
        return self.paired(rest)

    def paired(self, values: Floats) -> Floats:
        """Means (k, ...) over 2 s of ``values`` (n, ...) at the strides."""
        means: Floats = 0.5 * (values[self.second] + values[self.second - 1])
        return means

    @property
    def road_load(self) -> tuple[Floats, Floats]:
        """A [N], C [N s^2/m^2] and m [kg] (3,), and their sds (3,), which allow for an autocorrelated residual."""
        inverse = np.linalg.pinv(self._columns)
        theta = inverse @ self.power
        influence = inverse * (self.power - self._columns @ theta)
        sds = np.array([_sd(row, len(theta)) for row in influence])
        m, A, C = theta[:ROAD_LOAD] / self._unit[:ROAD_LOAD]
        sd_m, sd_A, sd_C = sds[:ROAD_LOAD] / self._unit[:ROAD_LOAD]
        return np.array([-A, -C, m]), np.array([sd_A, sd_C, sd_m])


def _sd(influence: Floats, parameters: int) -> float:
    """Standard deviation of a parameter from its ``influence`` (n,).

    The variance is multiplied by dof / remaining, because the fit takes one degree of freedom for each parameter. It is
    also multiplied by remaining / (remaining - 2), the variance of the Student distribution.
    """
    variance, dof = long_run_variance(influence)
    remaining = max(dof - parameters, MIN_DOF)
    return float(np.sqrt(variance * dof / (remaining - 2.0)))

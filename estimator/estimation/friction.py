"""Engine friction torque between the steps in which it is sent.

SPN 514 comes in steps of 1 % of the reference torque, often 25 N.m: half a step, lasting as long as the engine speed
does, is several per cent of the rolling resistance. But a reading of k steps says more than "k": friction lies within
half a step of it, and it follows the engine speed smoothly. A curve through all readings so far, held inside each
reading's own interval, is never worse than the interval and mostly far better than its middle.
"""

import numpy as np

from estimator.signals import Floats

DEGREE = 3  # of the curve in engine speed
SPEED_SCALE = 150.0  # rad/s, to keep powers of the speed near one
RIDGE = 1e-3  # readings' worth of prior at zero slope: keeps a drive at one speed solvable
FORGET = 36_000.0  # readings after which old ones fade, as oil warms: 12 min at 50 Hz


class FrictionCurve:
    """Running least-squares polynomial of friction over engine speed."""

    def __init__(self) -> None:
        self._moments = np.zeros((DEGREE + 1, DEGREE + 1))
        self._target = np.zeros(DEGREE + 1)
        self._levels = np.empty(0)

    def refine(self, engine_speed: Floats, reading: Floats) -> Floats:
        """Friction (n,) as a share of reference torque from ``reading`` (n,), both at ``engine_speed`` [rad/s].

        NaN where either is; the readings themselves until they have shown what their step is.
        """
        known = np.isfinite(engine_speed) & np.isfinite(reading)
        levels = np.unique(np.round(reading[known], 6))
        if not np.isin(levels, self._levels).all():
            self._levels = np.union1d(self._levels, levels)
        powers = np.vander(engine_speed[known] / SPEED_SCALE, DEGREE + 1, increasing=True)
        fade = np.exp(-known.sum() / FORGET)
        self._moments = fade * self._moments + powers.T @ powers
        self._target = fade * self._target + powers.T @ reading[known]
        if len(self._levels) < 2:
            return np.where(known, reading, np.nan)
        half_step = float(np.diff(self._levels).min()) / 2
        ridge = np.diag([0.0] + [RIDGE] * DEGREE)
        curve = powers @ np.linalg.solve(self._moments + ridge, self._target)
        refined = np.full(len(reading), np.nan)
        refined[known] = np.clip(curve, reading[known] - half_step, reading[known] + half_step)
        return refined

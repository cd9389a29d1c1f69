"""Strides on a level road."""

import numpy as np
from made_strides import made_strides

from estimator.components.drive_state import DriveState
from estimator.signals import Floats, Quantity

THETA = np.array([1739.0, 3.74, 27_190.0])  # A [N], C [N s^2/m^2], m [kg]


def driven(extra: Floats | float = 0.0, minutes: float = 40.0) -> DriveState:
    """Strides on a level road; the engine gives ``extra`` [W] besides."""
    rng = np.random.default_rng(2)
    n = round(60 * minutes)
    ends = np.arange(n + 1.0)
    speed = 18 + 6 * np.sin(2 * np.pi * ends / 190) + 2 * np.sin(2 * np.pi * ends / 47)
    v0, v1 = speed[:-1], speed[1:]
    v, a = 0.5 * (v0 + v1), v1 - v0
    force = THETA[0] + THETA[1] * v**2 + THETA[2] * a + extra / v + rng.normal(0, 60.0, n)
    context = {Quantity.ELAPSED: ends[:-1], Quantity.STOPS: np.zeros(n)}
    strides = made_strides(speed, force, context)
    found = DriveState.of(strides, is_level=True)
    assert found is not None
    return found

"""A drive by the model's own equation on a hilly road."""

import numpy as np
from made_strides import made_strides, past_speeds

from estimator.signals import Floats, Quantity
from estimator.strides import Strides

M, A, C = 25e3, 1600.0, 3.5

SEED = 3


def driven(n: int = 400, seed: int = SEED, power: Floats | None = None) -> Strides:
    """A drive by the model's own equation on a hilly road; ``power`` [W] (n,) is taken besides."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) + 0.5
    speed = 16 + 5 * np.sin(2 * np.pi * np.arange(n + 1) / 90) + np.cumsum(rng.normal(0, 0.02, n + 1))
    v0, v1 = speed[:-1], speed[1:]
    v, a = 0.5 * (v0 + v1), v1 - v0
    s = np.concatenate([[0.0], np.cumsum(v)])
    slope = 0.008 * np.sin(2 * np.pi * s[:-1] / 700 + 1.0) + 0.004 * np.sin(2 * np.pi * s[:-1] / 260)
    taken = np.zeros(n) if power is None else power
    force = M * a + A + C * v**2 + M * 9.80665 * slope + taken / v + M * rng.normal(0, 6e-3, n)
    context = {Quantity.ELAPSED: t, Quantity.ENGINE_SPEED: 8.0 * v, Quantity.STOPS: np.zeros(n), **past_speeds(v)}
    return made_strides(speed, force, context)

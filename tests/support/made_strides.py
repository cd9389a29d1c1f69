"""Strides of one second, with all that no signal shows."""

from collections.abc import Mapping

import numpy as np

from estimator.preparation.recursion import low_passed
from estimator.roles import PAST_SPEEDS
from estimator.signals import Floats, Quantity
from estimator.strides import DURATION, LAGS, Strides


def past_speeds(speed: Floats) -> dict[Quantity, Floats]:
    """Of strides at a ``speed`` [m/s] (n,), from a cold start."""
    return {quantity: low_passed(speed, 0.0, DURATION, time) for quantity, time in PAST_SPEEDS.items()}


def made_strides(speed: Floats, force: Floats, context: Mapping[Quantity, Floats]) -> Strides:
    """Of the ``speed`` [m/s] (n + 1,) at their ends and the measured ``force`` [N] (n,), the same at every lag."""
    n, v0, v1 = len(force), speed[:-1], speed[1:]
    v = 0.5 * (v0 + v1)
    s, unknown = np.concatenate([[0.0], np.cumsum(v)]), np.full(n, np.nan)
    return Strides(
        t=np.arange(n) + 0.5,
        rows=np.full(n, 10),
        known=np.ones(n, dtype=bool),
        v0=v0,
        v1=v1,
        s0=s[:-1],
        s1=s[1:],
        a=v1 - v0,
        speed_squared=v**2,
        force=np.repeat(force[:, None], len(LAGS), axis=1),
        gearing=np.full(n, 8.0),
        density=unknown,
        altitude=unknown,
        grade=unknown,
        grade_offset_sd=unknown,
        gravity=unknown,
        context=dict(context),
    )

"""What is large while the vehicle is cold, and decays: by one exponential of the time since the drive began."""

import numpy as np

from estimator.model.effects.effect import Shape, View
from estimator.signals import Floats, Quantity


def cold(view: View, time: Shape) -> Floats:
    """Share (n,) that is left, with a time constant ``time`` [s]."""
    left: Floats = np.exp(-view.context[Quantity.ELAPSED] / time)
    return left


def finer_times(time: Shape, _: float) -> tuple[Shape, ...]:
    """Time constants [s] between one of a grid and its neighbours."""
    return tuple(time * share for share in (0.8, 0.87, 0.93, 1.0, 1.08, 1.16, 1.25))


def told_time(time: Shape) -> str:
    """A time constant [s] in words."""
    return f"time constant {time / 60:.0f} min"

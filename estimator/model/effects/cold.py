"""What is large while the vehicle is cold, and falls with the time t since the drive began.

Temperatures approach those of a warm vehicle about exponentially (tyres: Nielsen and Sandberg, SAE 2002-01-1200),
x = exp(-t / tau) being the share of the way that is left. What is proportional to the temperature falls as x. The loss
in rubber and the viscosity of oil fall about exponentially with the temperature: of ln(cold / warm) = k, the excess
over the warm value

    (exp(k x) - 1) / (exp(k) - 1)

is left, which is x for a small k and falls faster at first for a large one.
"""

import numpy as np

from estimator.model.effects.effect import Shape, View
from estimator.signals import Floats, Quantity

STEEPNESS = (0.0, 1.5, 3.0)  # k: a warm loss of all but the excess itself (linear), of 1/4.5 and 1/20 of the cold one
LARGEST_STEEPNESS = 6.0
TIMES_NEAR = (0.8, 0.87, 0.93, 1.0, 1.08, 1.16, 1.25)  # of a time constant
STEEPNESS_NEAR = (-0.5, 0.0, 0.5)


def cold(view: View, time: Shape) -> Floats:
    """Share (n,) of the way to a warm vehicle that is left, with a time constant ``time`` [s]."""
    left: Floats = np.exp(-view.context[Quantity.ELAPSED] / time)
    return left


def excess(view: View, shape: Shape) -> Floats:
    """Share (n,) that is left of an excess that falls exponentially with temperature; time constant [s] and k."""
    time, steepness = shape
    left = cold(view, time)
    return np.expm1(steepness * left) / np.expm1(steepness) if steepness else left


def excesses(times: tuple[float, ...]) -> tuple[Shape, ...]:
    """Shapes with each of the time constants [s]."""
    return tuple((time, steepness) for time in times for steepness in STEEPNESS)


def finer_times(time: Shape, _: float) -> tuple[Shape, ...]:
    """Time constants [s] between one of a grid and its neighbours."""
    return tuple(time * share for share in TIMES_NEAR)


def finer_excesses(shape: Shape, _: float) -> tuple[Shape, ...]:
    """Shapes of `excess` between one of a grid and its neighbours."""
    time, steepness = shape
    near = dict.fromkeys(float(np.clip(steepness + more, 0.0, LARGEST_STEEPNESS)) for more in STEEPNESS_NEAR)
    return tuple((time * share, k) for share in TIMES_NEAR for k in near)


def told_time(time: Shape) -> str:
    """A time constant [s] in words."""
    return f"time constant {time / 60:.0f} min"


def told_excess(shape: Shape) -> str:
    """The time constant [s] of a shape of `excess` in words."""
    return told_time(shape[0])

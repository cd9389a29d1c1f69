"""Losses that are large while the vehicle is cold and fall as it warms.

x is the remaining share [1] of the temperature difference to a warm vehicle. In gears, cabin and battery it falls about
exponentially with the time t since the drive began, x = exp(-t / tau). Tyres and oil are warmed by driving and cool at
a standstill. They approach a temperature that belongs to their speed (Nielsen and Sandberg, SAE 2002-01-1200). With the
speed v_tau low-passed over tau, and the speed v_w at which tyres are tested warm,

    x = 1 - v_tau / v_w,

which is negative for tyres warmer than at v_w. A loss proportional to the temperature falls as x. The loss in rubber
and the viscosity of oil fall about exponentially with the temperature. With k = ln(cold / warm), the remaining share of
the excess over the warm value is

    (exp(k x) - 1) / (exp(k) - 1)

which is x for a small k and falls faster at first for a large one.
"""

import numpy as np

from estimator.model.effects.effect import Shape, View
from estimator.roles import PAST_SPEEDS
from estimator.signals import Floats, Quantity

WARM_SPEED = 80 / 3.6  # m/s, at which rolling resistance is measured (ISO 28580): A is that of tyres so warm
STEEPNESS = (0.0, 1.5, 3.0)  # k: in proportion to the temperature; cold losses of 4.5 and 20 times the warm one
LARGEST_STEEPNESS = 6.0
TIMES_NEAR = (0.8, 0.87, 0.93, 1.0, 1.08, 1.16, 1.25)  # of a time constant
STEEPNESS_NEAR = (-0.5, 0.0, 0.5)


def cold_by_time(view: View, time: Shape) -> Floats:
    """Remaining share x (n,) of the temperature difference, with a time constant ``time`` [s]."""
    left: Floats = np.exp(-view.context[Quantity.ELAPSED] / time)
    return left


def cold_by_speed(view: View, time: Shape) -> Floats:
    """Remaining share x (n,) of tyres or oil, with a time constant ``time`` [s] in the range of PAST_SPEEDS.

    The low-passed speed is interpolated over the logarithm of the time constant.
    """
    times = np.log([*PAST_SPEEDS.values()])
    position = float(np.interp(np.log(time), times, np.arange(len(times))))
    first = min(int(position), len(times) - 2)
    shorter, longer = [view.context[quantity] for quantity in PAST_SPEEDS][first : first + 2]
    past: Floats = shorter + (position - first) * (longer - shorter)
    return 1 - past / WARM_SPEED


def excess(left: Floats, steepness: float) -> Floats:
    """Remaining share (n,) of the excess, for the remaining share ``left`` (n,) = x and a ``steepness`` k."""
    return np.expm1(steepness * left) / np.expm1(steepness) if steepness else left


def excesses(times: tuple[float, ...]) -> tuple[Shape, ...]:
    """Shapes (time constant [s], k): each of ``times`` with each of STEEPNESS."""
    return tuple((time, steepness) for time in times for steepness in STEEPNESS)


def finer_times(time: Shape, _: float) -> tuple[Shape, ...]:
    """Time constants [s] of a finer grid around ``time`` [s]."""
    return tuple(time * share for share in TIMES_NEAR)


def finer_excesses(shape: Shape, _: float) -> tuple[Shape, ...]:
    """Shapes (time constant [s], k) of a finer grid around ``shape``."""
    time, steepness = shape
    shortest, longest = min(PAST_SPEEDS.values()), max(PAST_SPEEDS.values())
    times = dict.fromkeys(float(np.clip(time * share, shortest, longest)) for share in TIMES_NEAR)
    near = dict.fromkeys(float(np.clip(steepness + more, 0.0, LARGEST_STEEPNESS)) for more in STEEPNESS_NEAR)
    return tuple((nearer, k) for nearer in times for k in near)


def told_time(time: Shape) -> str:
    """Describe a time constant [s] in words."""
    return f"time constant {time / 60:.0f} min"


def told_excess(shape: Shape) -> str:
    """Describe the time constant of a shape (time constant [s], k) in words."""
    return told_time(shape[0])

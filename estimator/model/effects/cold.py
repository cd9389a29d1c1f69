"""What is large while the vehicle is cold, and falls as it warms.

x is the share of the way to a warm vehicle that is left. Gears, cabin and battery approach the temperature of a warm
vehicle about exponentially with the time t since the drive began, x = exp(-t / tau). Tyres and oil are warmed by the
driving: they approach the temperature that belongs to their speed (Nielsen and Sandberg, SAE 2002-01-1200), and cool
where the vehicle stands. With v_tau, the speed low-passed over tau, and the speed v_w at which tyres are tested warm,

    x = 1 - v_tau / v_w,

below zero for what is warmer than at that speed. What is proportional to the temperature falls as x. The loss in
rubber and the viscosity of oil fall about exponentially with the temperature: of ln(cold / warm) = k, the excess over
the warm value

    (exp(k x) - 1) / (exp(k) - 1)

is left, which is x for a small k and falls faster at first for a large one.
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
    """Share (n,) of the way to a warm vehicle that is left, with a time constant ``time`` [s]."""
    left: Floats = np.exp(-view.context[Quantity.ELAPSED] / time)
    return left


def cold_by_speed(view: View, time: Shape) -> Floats:
    """Share (n,) of the way to warm tyres or oil that is left, with a time constant [s] in the range of PAST_SPEEDS.

    Between two time constants the low-passed speed is interpolated over their logarithm.
    """
    times = np.log([*PAST_SPEEDS.values()])
    place = float(np.interp(np.log(time), times, np.arange(len(times))))
    first = min(int(place), len(times) - 2)
    shorter, longer = [view.context[quantity] for quantity in PAST_SPEEDS][first : first + 2]
    past: Floats = shorter + (place - first) * (longer - shorter)
    return 1 - past / WARM_SPEED


def excess(left: Floats, steepness: float) -> Floats:
    """Share (n,) of an excess where ``left`` (n,) is left of the way to a warm vehicle, for a ``steepness`` k."""
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
    shortest, longest = min(PAST_SPEEDS.values()), max(PAST_SPEEDS.values())
    times = dict.fromkeys(float(np.clip(time * share, shortest, longest)) for share in TIMES_NEAR)
    near = dict.fromkeys(float(np.clip(steepness + more, 0.0, LARGEST_STEEPNESS)) for more in STEEPNESS_NEAR)
    return tuple((nearer, k) for nearer in times for k in near)


def told_time(time: Shape) -> str:
    """A time constant [s] in words."""
    return f"time constant {time / 60:.0f} min"


def told_excess(shape: Shape) -> str:
    """The time constant [s] of a shape of `excess` in words."""
    return told_time(shape[0])

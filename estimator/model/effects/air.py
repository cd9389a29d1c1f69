"""Effects of the air: wind, weather, and vehicles ahead."""

from math import degrees, pi

import numpy as np

from estimator.model.effects.effect import Effect, Shape, Timing, View, always
from estimator.signals import Floats, Quantity

USUAL_WIND = 5.0  # m/s
DIRECTIONS = tuple(2 * pi * k / 24 for k in range(24))  # rad
ACROSS = (0.0, 10.0, 20.0, 40.0, 70.0)  # m/s, of the drag that wind across the road adds: bodies dislike yaw
WINDS = tuple((direction, across) for direction in DIRECTIONS for across in ACROSS)
TURNS = tuple(pi / 180 * degree for degree in (-7.5, -5.0, -2.5, 0.0, 2.5, 5.0, 7.5))  # rad
FINER_ACROSS = ((1.0, 0.0), (0.6, 0.0), (0.8, 0.0), (1.25, 0.0), (1.6, 0.0), (1.0, 5.0))  # times, and [m/s] more


def _wind(view: View, wind: Shape) -> Floats:
    direction, across = wind
    along = np.cos(view.context[Quantity.HEADING] - direction)
    square = USUAL_WIND * along**2 + across * (1 - along**2)
    drag: Floats = view.C * view.density * view.v * (2 * view.v * along + square)
    return drag


def _winds_near(wind: Shape) -> tuple[Shape, ...]:
    direction, across = wind
    return tuple((direction + turn, across * times + more) for turn in TURNS for times, more in FINER_ACROSS)


HEADWIND = Effect(
    name="headwind",
    equation="C (2 v w cos d + w^2 (cos^2 d + k sin^2 d)) v",
    source="drag is proportional to the square of the relative speed of the air (SAE J1263)",
    symbol="wind",
    unit="m/s",
    power=_wind,
    usual=always(USUAL_WIND),
    needs=(Quantity.HEADING,),
    shapes=WINDS,
    finer=_winds_near,
    describe=lambda wind: f"from {degrees(wind[0]) % 360:.0f} deg",
    breaks="the way back over the same road, with the heading on the bus",
)

AIR_DENSITY = Effect(
    name="air_density",
    equation="C (rho / rho0 - 1) v^3",
    source="ideal gas; applied, not fitted, where temperature and pressure are known",
    symbol="relative density",
    unit="1",
    power=lambda view, shape: view.C * view.v**3,
    usual=always(0.05),
    positive=False,
    absorbed=True,
    breaks="ambient temperature and air pressure on the bus",
)

DRAFTING = Effect(
    name="drafting",
    equation="-dC v^3 u(t)",
    source="drag in the wake of a vehicle ahead (platooning studies, NREL)",
    symbol="share of C",
    unit="1",
    power=lambda view, shape: -view.C * view.density * view.v**3,
    usual=always(0.25),
    largest=0.5,
    timing=Timing.SWITCHING,
    breaks="a change of speed behind the vehicle ahead, or the distance to it on the bus",
)

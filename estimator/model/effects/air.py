"""Effects of the air: wind, weather, and vehicles ahead."""

from math import degrees, pi

import numpy as np

from estimator.model.effects.effect import Effect, Shape, Timing, View, always
from estimator.signals import Floats, Quantity
from estimator.units import HOUR

USUAL_WIND = 5.0  # m/s
DIRECTIONS = tuple(2 * pi * k / 24 for k in range(24))  # rad
YAWED = (0.0, 0.05, 0.1, 0.2)  # share of C that oblique air adds at TEN_DEGREES
TEN_DEGREES = pi / 18
LARGEST_YAW = 0.3  # rad, about the yaw from which on the flow has separated and the drag rises no more
WINDS = tuple((direction, yawed, LARGEST_YAW, USUAL_WIND) for direction in DIRECTIONS for yawed in YAWED)
TURNS = tuple(pi / 180 * degree for degree in (-6.0, -2.0, -0.6, 0.0, 0.6, 2.0, 6.0))  # rad
STEPS = (-0.03, -0.01, 0.0, 0.01, 0.03)  # of the share of C, and of the largest yaw [rad]
LOWEST_WIND = 0.5  # m/s: the column is per 1 m/s, and that of no wind is none


def _wind(view: View, wind: Shape) -> Floats:
    """Power [W] (n,) per 1 m/s of wind, exact at the wind speed of the shape."""
    direction, yawed, largest, usual = wind
    angle = view.context[Quantity.HEADING] - direction
    against, across = view.v + usual * np.cos(angle), usual * np.sin(angle)
    yaw = np.minimum(np.arctan2(np.abs(across), np.abs(against)), largest) / TEN_DEGREES
    relative = (1 + yawed * yaw**2) * np.hypot(against, across) * against
    drag: Floats = view.C * view.density * (relative - view.v**2) * view.v / usual
    return drag


def _finer_winds(wind: Shape, speed: float) -> tuple[Shape, ...]:
    """Winds near a shape, with its speed and with the fitted ``speed`` [m/s], at which their columns are exact.

    The yaw of the most drag differs between bodies: at one that is given, 0.04 rad too large, C is wrong by 3 sd.
    """
    direction, yawed, largest, usual = wind
    steps = [(turn, more, 0.0) for turn in TURNS for more in STEPS]
    steps += [(0.0, more, wider) for wider in STEPS for more in STEPS]
    return tuple(
        (direction + turn, max(yawed + more, 0.0), max(largest + wider, 0.0), max(exact, LOWEST_WIND))
        for turn, more, wider in dict.fromkeys(steps)
        for exact in (speed, usual)
    )


HEADWIND = Effect(
    name="headwind",
    equation="C ((1 + k min(yaw, y)^2) u (v + w cos d) - v^2) v, u^2 = (v + w cos d)^2 + (w sin d)^2",
    source="drag of the air that meets the vehicle, by its speed and yaw (SAE J1263)",
    symbol="wind",
    unit="m/s",
    power=_wind,
    usual_magnitude=always(USUAL_WIND),
    needs=(Quantity.HEADING,),
    shapes=WINDS,
    finer_shapes=_finer_winds,
    exact_at=lambda wind: float(wind[3]),
    shape_key=lambda wind: wind[:3],
    describe=lambda wind: f"from {degrees(wind[0]) % 360:.0f} deg",
    shown_by="the way back over the same road, with the heading on the bus",
)

AIR_DENSITY = Effect(
    name="air_density",
    equation="C d t v^3",
    source="ideal gas: 10 K change C by 3.5 %; not fitted where temperature and pressure are known",
    symbol="drift of density per hour",
    unit="1/h",
    power=lambda view, shape: view.C * view.v**3 * view.context[Quantity.ELAPSED] / HOUR,
    usual_magnitude=always(0.04),
    positive=False,
    needs=(Quantity.ELAPSED,),
    applied_with=(Quantity.AIR_DENSITY,),
    shown_by="ambient temperature and air pressure on the bus",
)

DRAFTING = Effect(
    name="drafting",
    equation="-dC v^3 u(t)",
    source="less drag in the wake of a vehicle ahead (NREL, platooning)",
    symbol="share of C",
    unit="1",
    power=lambda view, shape: -view.C * view.density * view.v**3,
    usual_magnitude=always(0.25),
    max_size=0.5,
    timing=Timing.SWITCHING,
    dwell_times=(200.0, 1000.0),  # behind a vehicle for minutes, or for a stage of a motorway
    shown_by="a change of speed behind the vehicle ahead, or the distance to it on the bus",
)

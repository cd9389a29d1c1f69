"""All effects that the diagnosis can name and the estimator can add. Adding one is adding one object.

Usual magnitudes are those of a heavy truck; what is not relative already goes with the mass, against TYPICAL_MASS.
"""

from collections.abc import Callable, Sequence
from math import degrees, pi

import numpy as np

from estimator.effects.effect import Effect, Shape, Timing, View
from estimator.errors import ConfigError
from estimator.signals import Floats, Quantity
from estimator.units import STANDARD_GRAVITY

TYPICAL_MASS = 27e3  # kg, a loaded tractor and semi-trailer
USUAL_WIND = 5.0  # m/s
HOUR = 3600.0  # s
DIRECTIONS = tuple(2 * pi * k / 24 for k in range(24))  # rad
SQUARES = (-32.0, -16.0, -8.0, 0.0, 8.0)  # m/s, of the part with the wind squared: along the road less across it
WINDS = tuple((direction, square) for direction in DIRECTIONS for square in SQUARES)
WARM_UP_TIMES = tuple(60.0 * minutes for minutes in (6, 10, 16, 25, 40, 60))  # s
FAN_EXPONENT = 3  # power of a fan over its speed

Usual = Callable[[Floats], float]


def _by_mass(value: float) -> Usual:
    return lambda road_load: value * float(road_load[2]) / TYPICAL_MASS


def _always(value: float) -> Usual:
    return lambda road_load: value


def _climbing(view: View, source: Shape) -> Floats:
    climb: Floats = STANDARD_GRAVITY * view.context[source]
    return climb


def _wind(view: View, wind: Shape) -> Floats:
    direction, square = wind
    along = np.cos(view.context[Quantity.HEADING] - direction)
    drag: Floats = view.C * view.density * view.v * (2 * view.v * along + square * along**2)
    return drag


def _warming(view: View, time: Shape) -> Floats:
    warming: Floats = view.A * view.v * np.exp(-view.context[Quantity.ELAPSED] / time)
    return warming


def _fan(view: View, source: Shape) -> Floats:
    if source is None:
        return np.ones_like(view.v)
    speed = view.context[source]
    fastest = float(np.nanmax(speed, initial=1.0))
    power: Floats = (speed / fastest) ** FAN_EXPONENT
    return power


CATALOGUE: tuple[Effect, ...] = (
    Effect(
        "grade",
        "m g v sin(th)",
        "component of gravity along the road",
        "mass on slopes",
        "kg",
        _climbing,
        usual=lambda road_load: 2.0 * float(road_load[2]),
        shapes=(Quantity.CLIMB_BY_GRADE, Quantity.CLIMB_BY_ALTITUDE, Quantity.CLIMB_BY_ACCELEROMETER),
        is_gravity=True,
        is_noisy=True,
        breaks="altitude, grade or an inertial accelerometer on the bus",
    ),
    Effect(
        "headwind",
        "C ((v + w cos d)^2 - v^2) v",
        "drag goes with the square of the air's relative speed (SAE J1263)",
        "wind",
        "m/s",
        _wind,
        usual=_always(USUAL_WIND),
        needs=(Quantity.HEADING,),
        shapes=WINDS,
        describe=lambda wind: f"from {degrees(wind[0]):.0f} deg",
        breaks="the way back over the same road, with the heading on the bus",
    ),
    Effect(
        "air_density",
        "C (rho / rho0 - 1) v^3",
        "ideal gas; applied, not fitted, where temperature and pressure are known",
        "relative density",
        "1",
        lambda view, shape: view.C * view.v**3,
        usual=_always(0.05),
        positive=False,
        absorbed=True,
        breaks="ambient temperature and air pressure on the bus",
    ),
    Effect(
        "warm_up",
        "A al exp(-t / tau) v",
        "rolling resistance of tyres falls as they warm (ISO 28580; SAE J2452)",
        "cold excess of A",
        "1",
        _warming,
        usual=_always(0.25),
        needs=(Quantity.ELAPSED,),
        shapes=WARM_UP_TIMES,
        describe=lambda time: f"time constant {time / 60:.0f} min",
        breaks="a drive that starts with warm tyres",
    ),
    Effect(
        "viscous_drag",
        "B v^2",
        "churning of oil in axles and gearbox",
        "B",
        "N s/m",
        lambda view, shape: view.v**2,
        usual=lambda road_load: 0.5 * float(road_load[0]) / 20.0,
        breaks="a coast-down over a wide range of speed, or A from a data sheet",
    ),
    Effect(
        "torque_gain",
        "e P",
        "the torque signal is some per cent off, or the driveline takes them",
        "gain error",
        "1",
        lambda view, shape: view.P,
        usual=_always(0.05),
        positive=False,
        absorbed=True,
        equivalent=("speed_scale",),
        breaks="a known mass (weigh ticket)",
    ),
    Effect(
        "load_loss",
        "k F^2 v",
        "tyre slip and gear mesh: loss in proportion to the force transmitted, twice",
        "k",
        "1/N",
        lambda view, shape: view.P**2 / view.v,
        usual=lambda road_load: 1e-6 * TYPICAL_MASS / float(road_load[2]),
        is_noisy=True,
        breaks="the speed of a wheel that is not driven, or GPS speed",
    ),
    Effect(
        "torque_bias",
        "T0 w",
        "an offset of the torque signal, or engine drag that the friction torque leaves out",
        "T0",
        "N m",
        lambda view, shape: view.context[Quantity.ENGINE_SPEED],
        usual=_by_mass(50.0),
        positive=False,
        needs=(Quantity.ENGINE_SPEED,),
        at_rest=lambda idle: idle,
        breaks="driving the same speed in several gears, or coasting in gear",
    ),
    Effect(
        "auxiliary_load",
        "P0",
        "alternator, steering pump, compressor, air conditioning",
        "P0",
        "W",
        lambda view, shape: np.ones_like(view.v),
        usual=_by_mass(8e3),
        at_rest=lambda idle: 1.0,
        breaks="two minutes of idling at rest",
    ),
    Effect(
        "auxiliary_cycling",
        "Pf u(t)",
        "engine fan or air compressor: two levels, switched by temperature or pressure",
        "Pf",
        "W",
        _fan,
        usual=_by_mass(25e3),
        shapes=(Quantity.FAN_SPEED, None),
        timing=Timing.SWITCHING,
        dwells=(200.0, 25.0),
        breaks="the state of the fan on the bus",
    ),
    Effect(
        "rotating_inertia",
        "J (w / v)^2 v a",
        "kinetic energy of engine and flywheel",
        "J",
        "kg m^2",
        lambda view, shape: view.context[Quantity.ENGINE_SPEED] ** 2 * view.a / view.v,
        usual=_by_mass(3.0),
        needs=(Quantity.ENGINE_SPEED,),
        is_noisy=True,
        breaks="accelerations in low gears",
    ),
    Effect(
        "mass_step",
        "dm (A + m dv/dt) v after a standstill",
        "load taken on or off",
        "share of the mass",
        "1",
        lambda view, shape: (view.A + view.m * view.a) * view.v,
        usual=_always(0.3),
        positive=False,
        timing=Timing.STEP,
        is_noisy=True,
        breaks="accelerations after the stop, or axle loads on the bus",
    ),
    Effect(
        "resistance_segment",
        "dA v on [t1, t2]",
        "wet road, dragging brake, soft tyre",
        "share of A",
        "1",
        lambda view, shape: view.A * view.v,
        usual=_always(0.25),
        timing=Timing.WINDOW,
        breaks="a change of speed inside the window",
    ),
    Effect(
        "cornering",
        "k v ay^2",
        "induced drag of tyres under side force",
        "k",
        "N s^4/m^2",
        lambda view, shape: view.v * view.context[Quantity.LATERAL_ACCELERATION] ** 2,
        usual=_by_mass(600.0),
        needs=(Quantity.LATERAL_ACCELERATION,),
        breaks="yaw rate or lateral acceleration on the bus, and bends taken without braking",
    ),
    Effect(
        "sensor_drift",
        "g t P",
        "a torque signal that drifts as it warms",
        "drift per hour",
        "1/h",
        lambda view, shape: view.P * view.context[Quantity.ELAPSED] / HOUR,
        usual=_always(0.08),
        positive=False,
        needs=(Quantity.ELAPSED,),
        is_noisy=True,
        breaks="the same stretch at the beginning and the end of the drive",
    ),
    Effect(
        "speed_scale",
        "v -> (1 + e) v",
        "tyre wear or a wrong rolling radius",
        "scale error",
        "1",
        lambda view, shape: view.P,
        usual=_always(0.02),
        positive=False,
        absorbed=True,
        equivalent=("torque_gain",),
        breaks="GPS speed or distance on the bus",
    ),
    Effect(
        "brake_use",
        "F v u(t) while the engine pulls",
        "a service brake that drags, or is held against the engine, and no switch tells",
        "brake force",
        "N",
        lambda view, shape: view.v,
        usual=_by_mass(4e3),
        timing=Timing.SWITCHING,
        dwells=(12.0,),
        breaks="brake switch or brake pressure on the bus",
    ),
    Effect(
        "time_lag",
        "P(t - tau) - P(t)",
        "power and speed reach the bus with different delays, or the speed is filtered; taken out by the alignment",
        "lag of power",
        "s",
        lambda view, shape: np.zeros_like(view.v),
        usual=_always(0.2),
        positive=False,
        absorbed=True,
        equivalent=("speed_filter",),
        breaks="both signals from one control unit, at a high rate",
    ),
    Effect(
        "speed_filter",
        "P(t + tau) - P(t)",
        "a control unit that filters the wheel speed makes it late; to first order a lag of power the other way",
        "lag of power",
        "s",
        lambda view, shape: np.zeros_like(view.v),
        usual=_always(0.2),
        positive=False,
        absorbed=True,
        equivalent=("time_lag",),
        breaks="both signals from one control unit, at a high rate",
    ),
    Effect(
        "drafting",
        "-dC v^3 u(t)",
        "drag in the wake of a vehicle ahead (platooning studies, NREL)",
        "share of C",
        "1",
        lambda view, shape: -view.C * view.density * view.v**3,
        usual=_always(0.25),
        timing=Timing.SWITCHING,
        breaks="a change of speed behind the vehicle ahead, or the distance to it on the bus",
    ),
)

BY_NAME = {effect.name: effect for effect in CATALOGUE}


def named(names: Sequence[str]) -> tuple[Effect, ...]:
    """The effects that a configuration asks for.

    Raises
    ------
    ConfigError
        A name that is not known, or an effect that only a diagnosis can find the times of.
    """
    for name in names:
        if name not in BY_NAME:
            raise ConfigError(f"effects: {name!r} is not known; there are {', '.join(BY_NAME)}")
        if not BY_NAME[name].streams:
            able = ", ".join(effect.name for effect in CATALOGUE if effect.streams)
            raise ConfigError(f"effects: {name!r} cannot be part of the model, only diagnosed; those that can: {able}")
    return tuple(BY_NAME[name] for name in dict.fromkeys(names))

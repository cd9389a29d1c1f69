"""Types exchanged between the drive and the effects: moment, scene, readings, and action of an effect."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from estimator.signals import Floats
from estimator.simulation.route import Route
from estimator.simulation.truck import Truck

STEP = 0.01  # s, of the simulation
FAN_SLIP = 0.2  # share of its speed at which a fan turns while it is released


@dataclass(slots=True, kw_only=True)
class Moment:
    """Quantities of one step of the drive that an effect may depend on.

    Time ``t`` [s], position ``s`` [m], speed ``v`` [m/s], acceleration ``a`` of the step before [m/s^2], ``force`` of
    the engine at the wheels [N], ``engine_speed`` [rad/s], ``gearing`` [rad/m], ``gear``; ``closed``: the closed clutch
    couples engine and wheels. An effect may set ``brake_light``.
    """

    t: float = 0.0
    s: float = 0.0
    v: float = 0.0
    a: float = 0.0
    force: float = 0.0
    engine_speed: float = 0.0
    gearing: float = 0.0
    gear: int = 0
    closed: bool = False
    brake_light: bool = False


@dataclass(frozen=True, slots=True)
class Scene:
    """Truck, road and duration [s] of a drive, and the random generator of one effect."""

    truck: Truck
    route: Route
    duration: float
    rng: np.random.Generator


@dataclass(frozen=True, slots=True, kw_only=True)
class Reading:
    """Readings of the control units without noise; arrays (n,).

    ``t`` [s], ``v`` [m/s], ``a`` [m/s^2] of the wheels, net engine ``torque`` [N.m] and ``engine_speed`` [rad/s];
    ``torque_step`` [N.m] is the coarsest resolution of the torque before the bus, 0 if only the bus rounds.
    """

    t: Floats
    v: Floats
    a: Floats
    torque: Floats
    engine_speed: Floats
    torque_step: float = 0.0

    @property
    def power(self) -> Floats:
        """Power by the readings [W] (n,)."""
        torque = self.torque
        if self.torque_step > 0.0:
            torque = np.round(torque / self.torque_step) * self.torque_step
        return torque * self.engine_speed


@dataclass(frozen=True, slots=True, kw_only=True)
class Action:
    """Action of one effect in one drive. Functions are called once a step, in order of time; None is not called.

    Parameters
    ----------
    force
        Returns the force against the truck [N].
    power
        Returns the power taken from the crank before the clutch [W].
    inertia
        Returns the addition to the moving mass [kg].
    reading
        Changes the readings of the control units.
    temperature
        Returns the ambient temperature [K] at times [s].
    route
        Road as changed by the effect.
    retarder
        Largest force of a retarder that acts before the service brake [N].
    fan, coolant
        Filled by the effect, step by step: whether a fan runs, and the temperature that switches it [K].
    active
        Stretches of time [s] of a bounded effect, filled in at the latest when they begin.
    """

    force: Callable[[Moment], float] | None = None
    power: Callable[[Moment], float] | None = None
    inertia: Callable[[Moment], float] | None = None
    reading: Callable[[Reading], Reading] | None = None
    temperature: Callable[[Floats], Floats] | None = None
    route: Route | None = None
    retarder: float = 0.0
    fan: list[bool] = field(default_factory=list)
    coolant: list[float] = field(default_factory=list)
    active: list[tuple[float, float]] = field(default_factory=list)


def along(values: Floats, spacing: float) -> Callable[[float], float]:
    """Return a fast linear interpolation of ``values`` (n,), equally spaced from 0; constant beyond the last."""
    table: list[float] = [*values.tolist(), float(values[-1])]
    last = len(values) - 1

    def at(x: float) -> float:
        cell = x / spacing
        i = int(cell)
        if i >= last:
            return table[last]
        return table[i] + (cell - i) * (table[i + 1] - table[i])

    return at

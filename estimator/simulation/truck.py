"""Class-8 truck: mass, resistances, engine, 12-speed automated gearbox and wheels."""

from dataclasses import dataclass
from math import pi
from typing import TypeVar

import numpy as np

from estimator.signals import Floats
from estimator.units import STANDARD_GRAVITY

RPM = 2 * pi / 60  # rad/s
GEARS = 12
RATIO_STEP = 1.277  # ratio of neighbouring gears; the top gear is direct

Speed = TypeVar("Speed", float, Floats)


@dataclass(frozen=True, slots=True, kw_only=True)
class Truck:
    """Vehicle of a simulated drive.

    Parameters
    ----------
    mass
        Moving mass [kg].
    A
        Rolling and friction force [N].
    C
        Aerodynamic coefficient [N/(m/s)^2].
    reference_torque
        Torque of 100 % on the bus, SPN 544 [N.m].
    peak_torque
        Net torque of the engine between 1000 rpm and rated power [N.m].
    rated_power
        Net power limit of the engine [W].
    idle_speed, max_speed
        Engine speeds [rad/s].
    friction
        Engine friction torque ``c0 + c1 w + c2 w^2`` [N.m], [N.m s], [N.m s^2].
    gear_ratios
        Engine turns per turn of the propeller shaft, lowest gear first [1].
    final_drive
        Propeller shaft turns per wheel turn [1].
    wheel_radius
        Rolling radius [m].
    efficiency
        Share of the engine's power that reaches the wheels [1].
    shifts_under_power
        True if gears change without an interruption, as in a car with two clutches or a converter.
    """

    mass: float
    A: float
    C: float
    reference_torque: float = 2500.0
    peak_torque: float = 2250.0
    rated_power: float = 335e3
    idle_speed: float = 600.0 * RPM
    max_speed: float = 2100.0 * RPM
    friction: tuple[float, float, float] = (95.0, 0.25, 0.0024)
    gear_ratios: tuple[float, ...] = tuple(RATIO_STEP ** (GEARS - gear) for gear in range(1, GEARS + 1))
    final_drive: float = 2.7
    wheel_radius: float = 0.5
    efficiency: float = 1.0
    shifts_under_power: bool = False

    def max_torque(self, engine_speed: float) -> float:
        """Full-load net torque [N.m] at an engine speed [rad/s]."""
        if engine_speed <= self.idle_speed:
            return 0.5 * self.peak_torque
        if engine_speed >= self.max_speed:
            return 0.0
        rise = 0.5 + 0.5 * (engine_speed - self.idle_speed) / (400.0 * RPM)
        governor = (self.max_speed - engine_speed) / (100.0 * RPM)
        return min(self.peak_torque * min(rise, governor, 1.0), self.rated_power / engine_speed)

    def friction_torque(self, engine_speed: Speed) -> Speed:
        """Torque lost inside the engine [N.m] at an engine speed [rad/s]."""
        c0, c1, c2 = self.friction
        return c0 + (c1 + c2 * engine_speed) * engine_speed

    def gearing(self, gear: int) -> float:
        """Engine rotation per distance [rad/m] in a gear (1 is the lowest)."""
        return self.gear_ratios[gear - 1] * self.final_drive / self.wheel_radius

    @property
    def start_gear(self) -> int:
        """Gear in which the truck starts; a lighter truck starts in a higher gear."""
        return 1 + (self.mass < 30e3) + (self.mass < 18e3)


def draw_car(rng: np.random.Generator) -> Truck:
    """Draw a passenger car: 1.1-2.2 t, A 120-230 N, C 0.32-0.5 N/(m/s)^2, an engine of 400 N m and 110 kW."""
    return Truck(
        mass=rng.uniform(1100.0, 2200.0),
        A=rng.uniform(120.0, 230.0),
        C=rng.uniform(0.32, 0.5),
        reference_torque=400.0,
        peak_torque=360.0,
        rated_power=110e3,
        friction=(12.0, 0.05, 0.0002),
        shifts_under_power=True,
    )


def draw_truck(rng: np.random.Generator) -> Truck:
    """Draw a class-8 truck: 12-38 t, A 0.8-2.8 kN from the rolling coefficient of its tyres, C 3-4.3 N/(m/s)^2."""
    mass = rng.uniform(12e3, 38e3)
    rolling = rng.uniform(0.0052, 0.0078)  # rolling coefficient of truck tyres
    reference = float(rng.choice([2100, 2300, 2500, 2700]))
    return Truck(
        mass=mass,
        A=float(np.clip(rolling * mass * STANDARD_GRAVITY, 800.0, 2800.0)),
        C=rng.uniform(3.0, 4.3),
        reference_torque=reference,
        peak_torque=0.9 * reference,
        rated_power=reference * 134.0,
        final_drive=rng.uniform(2.6, 3.0),
        wheel_radius=rng.uniform(0.49, 0.52),
    )

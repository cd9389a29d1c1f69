"""True quantities of a drive, and the power that each effect adds to the measured one."""

from collections.abc import Mapping
from dataclasses import dataclass
from math import cos, pi

import numpy as np
from numpy.typing import NDArray

from estimator.signals import Floats, Mask
from estimator.simulation.effects.effect import Effect, Span
from estimator.simulation.moment import Reading
from estimator.simulation.truck import Truck
from estimator.units import EARTH_RADIUS

ORIGIN = 48.0 * pi / 180, 11.0 * pi / 180  # rad, latitude and longitude where every drive begins


@dataclass(frozen=True, slots=True, kw_only=True)
class Truth:
    """True quantities of a drive, every ``STEP``; all arrays (n,).

    ``t`` [s], ``s`` [m], ``v`` [m/s], ``a`` [m/s^2], net engine ``torque`` [N.m] and ``engine_speed`` [rad/s] at the
    crank, ``brake`` and ``retarder`` force [N], ``gear``; ``engaged``: clutch closed in a gear; ``shifting``: a gear
    change is under way; ``braking``: the brake switch; ``parked``: parking brake on; ``grade`` rise over run [1],
    ``altitude`` [m], ``heading`` clockwise from north, not wrapped [rad], ``yaw_rate`` [rad/s] and
    ``lateral_acceleration`` [m/s^2] to the left, ``ambient_temperature`` and ``coolant_temperature`` [K],
    ``pressure`` [Pa], ``fan_speed`` [rad/s].

    ``reading`` are the readings of the control units without noise. ``effects`` are the requested effects, and
    ``active`` the stretches [s] of those bounded in time. ``effect_power`` [W] is the addition of each effect to the
    measured power. With the clutch closed and the service brake released,

        reading.power = A v + C v^3 + m v a + sum of effect_power,      v, a = reading.v, reading.a

    with A, C, m of the ``truck``. Besides the requested effects it has ``air_density`` on a road that is not level,
    ``grade`` on a road with slopes, and ``driveline_efficiency`` of a truck with losses there.
    """

    truck: Truck
    t: Floats
    s: Floats
    v: Floats
    a: Floats
    torque: Floats
    engine_speed: Floats
    brake: Floats
    retarder: Floats
    gear: NDArray[np.int64]
    engaged: Mask
    shifting: Mask
    braking: Mask
    parked: Mask
    grade: Floats
    altitude: Floats
    heading: Floats
    yaw_rate: Floats
    lateral_acceleration: Floats
    ambient_temperature: Floats
    coolant_temperature: Floats
    pressure: Floats
    fan_speed: Floats
    reading: Reading
    effects: tuple[Effect, ...]
    active: Mapping[str, list[Span]]
    effect_power: Mapping[str, Floats]

    @property
    def power(self) -> Floats:
        """Net power at the crank [W] (n,)."""
        return self.torque * self.engine_speed

    @property
    def position(self) -> tuple[Floats, Floats]:
        """Latitude and longitude [rad] (n,), from the heading integrated over the distance from ORIGIN.

        The ground is the tangential plane there, so a degree of longitude has one length.
        """
        steps = np.diff(self.s, prepend=0.0)
        north, east = np.cumsum(steps * np.cos(self.heading)), np.cumsum(steps * np.sin(self.heading))
        latitude, longitude = ORIGIN
        return latitude + north / EARTH_RADIUS, longitude + east / (EARTH_RADIUS * cos(latitude))

    @property
    def driven(self) -> Mask:
        """Mask (n,) of the times with a rolling truck, a closed clutch, no gear change and a released service brake."""
        free: Mask = self.engaged & ~self.shifting & (self.brake < 1.0) & (self.v > 0.0)
        return free

    def rms_power(self, name: str) -> float:
        """Root mean square [W] of the addition of an effect to the measured power, while `driven`."""
        return float(np.sqrt(np.mean(self.effect_power[name][self.driven] ** 2))) if self.driven.any() else 0.0

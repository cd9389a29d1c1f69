"""A drive in time: forces move the truck, step by step.

State: position s [m], speed v [m/s], torque of the engine at the clutch T [N.m], brake force [N]. Newton's second law

    m dv/dt = T G - brake - A - C v^2 - m g sin(theta) - disturbance,      G = engine rotation per distance [rad/m]

is integrated with Heun's method (second order), torque and brake pressure by first-order lags. While the clutch is
open, slips or between two gears the engine turns freely, and its power is not that at the wheels.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import exp

import numpy as np
from numpy.typing import NDArray

from estimator.signals import Floats
from estimator.simulation.driver import BRAKE_THRESHOLD, PERIOD, Driver
from estimator.simulation.gearbox import Gearbox, Phase
from estimator.simulation.route import GRADE_SPACING, Route
from estimator.simulation.truck import Truck
from estimator.units import STANDARD_GRAVITY

STEP = 0.01  # s
ENGINE_LAG = 0.25  # s, torque behind the pedal
UNLOAD_LAG = 0.07  # s, torque taken away for a shift
BRAKE_LAG = 0.25  # s, air brakes
DECISION_STEPS = round(PERIOD / STEP)


@dataclass(frozen=True, slots=True)
class Disturbance:
    """Physics beyond the plain truck, as functions of time, position, speed (SI); none by default.

    ``force(t, s, v)`` [N] holds the vehicle back; ``power(t, s, v, engine_speed)`` [W] is taken from the crank
    before the clutch, e.g. by a fan.
    """

    force: Callable[[float, float, float], float] | None = None
    power: Callable[[float, float, float, float], float] | None = None


@dataclass(frozen=True, slots=True)
class Truth:
    """What really happened, every ``STEP``; all arrays (n,).

    ``t`` [s], ``s`` [m], ``v`` [m/s], ``a`` [m/s^2], net engine ``torque`` [N.m] and ``engine_speed`` [rad/s] at the
    crank, ``brake`` force [N], ``gear``; ``engaged``: clutch closed in a gear; ``shifting``: a gear change is under
    way; ``braking``: foot on the brake pedal; ``parked``: parking brake on; ``grade`` rise over run [1],
    ``altitude`` [m].
    """

    truck: Truck
    t: Floats
    s: Floats
    v: Floats
    a: Floats
    torque: Floats
    engine_speed: Floats
    brake: Floats
    gear: NDArray[np.int64]
    engaged: NDArray[np.bool_]
    shifting: NDArray[np.bool_]
    braking: NDArray[np.bool_]
    parked: NDArray[np.bool_]
    grade: Floats
    altitude: Floats

    @property
    def power(self) -> Floats:
        """Net power at the crank [W]."""
        return self.torque * self.engine_speed


def drive(
    truck: Truck,
    route: Route,
    duration: float,
    rng: np.random.Generator,
    disturbance: Disturbance | None = None,
) -> Truth:
    """Drive ``truck`` along ``route`` for ``duration`` [s]; at the road's end it stands."""
    driver_rng, gearbox_rng = rng.spawn(2)
    driver = Driver(truck, route, duration, driver_rng)
    gearbox = Gearbox(truck, gearbox_rng)
    extra_force = disturbance.force if disturbance else None
    extra_power = disturbance.power if disturbance else None
    mass, A, C, efficiency = truck.mass, truck.A, truck.C, truck.efficiency
    slope_force = (mass * STANDARD_GRAVITY * route.grade / np.hypot(1.0, route.grade)).tolist()
    engine_gain, unload_gain, brake_gain = (1.0 - exp(-STEP / lag) for lag in (ENGINE_LAG, UNLOAD_LAG, BRAKE_LAG))
    threshold = BRAKE_THRESHOLD * mass

    steps = round(duration / STEP)
    speeds, places, accelerations, torques, engine_speeds, brakes = ([0.0] * steps for _ in range(6))
    gears, phases = [0] * steps, [Phase.OPEN] * steps
    braking_at, parked_at = [False] * steps, [False] * steps

    s = v = torque = brake = load = auxiliary = a = 0.0
    braking = True
    demand = driver.act(0.0, s, v, a, holding=False)
    for k in range(steps):
        t = k * STEP
        gearbox.step(t, STEP, v, demand.force, load)
        phase, gearing, engine_speed = gearbox.phase, gearbox.gearing, gearbox.engine_speed
        coupled = phase is Phase.DRIVE or phase is Phase.UNLOAD or phase is Phase.SLIP
        if not coupled:
            torque = 0.0
        if extra_power is not None:
            auxiliary = extra_power(t, s, v, engine_speed) / engine_speed

        # forces now
        cell = s / GRADE_SPACING
        i = int(cell)
        slope = slope_force[i] + (cell - i) * (slope_force[i + 1] - slope_force[i])
        holding_back = A + slope + (extra_force(t, s, v) if extra_force is not None else 0.0)
        lever = gearing * efficiency if torque > 0.0 else gearing / efficiency
        a = (torque * lever - brake - holding_back - C * v * v) / mass
        if v == 0.0 and a < 0.0:
            a = 0.0

        speeds[k], places[k], accelerations[k], torques[k] = v, s, a, torque + auxiliary
        engine_speeds[k], brakes[k], gears[k], phases[k] = engine_speed, brake, gearbox.gear, phase
        braking_at[k], parked_at[k] = braking, demand.parked

        # pedals
        if k % DECISION_STEPS == 0:
            demand = driver.act(t, s, v, a, holding=phase is Phase.UNLOAD or phase is Phase.NEUTRAL)
        force = demand.force
        drag = 0.0
        target = 0.0
        gain = unload_gain
        if phase is Phase.DRIVE or phase is Phase.SLIP:
            full = truck.max_torque(engine_speed) - auxiliary
            drag_torque = -truck.friction_torque(engine_speed) if phase is Phase.DRIVE else 0.0
            drag = drag_torque * gearing
            target = force / gearing
            if target > full:
                target = full
                driver.limit_force(full * gearing)
            elif target < drag_torque:
                target = drag_torque
            load = max(torque, 0.0) / max(full, 1.0)
            gain = engine_gain
        braking = force < drag - threshold or (braking and force < drag) or demand.standing
        brake_target = drag - force if braking else 0.0

        # Heun's step
        next_torque = torque + gain * (target - torque) if coupled else 0.0
        next_brake = brake + brake_gain * (brake_target - brake)
        guess = v + STEP * a
        lever = gearing * efficiency if next_torque > 0.0 else gearing / efficiency
        next_a = (next_torque * lever - next_brake - holding_back - C * guess * guess) / mass
        next_v = v + 0.5 * STEP * (a + next_a)
        if next_v <= 0.0 or (v == 0.0 and a <= 0.0 and next_a <= 0.0):
            next_v = 0.0
        s += 0.5 * STEP * (v + next_v)
        v, torque, brake = next_v, next_torque, next_brake

    place = np.array(places)
    profile = np.arange(len(route.grade)) * GRADE_SPACING
    code = np.array([phase.value for phase in phases])
    return Truth(
        truck=truck,
        t=STEP * np.arange(steps, dtype=np.float64),
        s=place,
        v=np.array(speeds),
        a=np.array(accelerations),
        torque=np.array(torques),
        engine_speed=np.array(engine_speeds),
        brake=np.array(brakes),
        gear=np.array(gears),
        engaged=(code == Phase.DRIVE.value) | (code == Phase.UNLOAD.value),
        shifting=(code == Phase.UNLOAD.value) | (code == Phase.NEUTRAL.value),
        braking=np.array(braking_at),
        parked=np.array(parked_at),
        grade=np.interp(place, profile, route.grade),
        altitude=np.interp(place, profile, route.altitude),
    )

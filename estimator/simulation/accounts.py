"""True quantities of a drive from its course: places, readings of the control units, and power of each effect."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.preparation.recursion import low_passed
from estimator.signals import Floats, Mask
from estimator.simulation.atmosphere import STANDARD_TEMPERATURE, pressure_at
from estimator.simulation.bends import CURVE_SPACING
from estimator.simulation.effects.effect import Effect
from estimator.simulation.effects.powertrain import COOL_DAY_RISE, COOLANT_TIME, THERMOSTAT, cruise_power
from estimator.simulation.gearbox import Phase
from estimator.simulation.moment import FAN_SLIP, STEP, Action, Reading
from estimator.simulation.route import GRADE_SPACING, Route
from estimator.simulation.truck import Truck
from estimator.simulation.truth import Truth
from estimator.units import STANDARD_GRAVITY

FAN_SPEED = 220.0  # rad/s, of a hydraulic fan, whose power does not depend on the engine's speed
RETARDER_SPEED = 4.0  # m/s, below which the service brake does all

Ledgers = Mapping[tuple[str, str], Floats]


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """Integrated course of the truck, every ``STEP``; arrays (n,) as in `Truth`, and ``phase`` of the gearbox."""

    t: Floats
    s: Floats
    v: Floats
    a: Floats
    torque: Floats
    engine_speed: Floats
    brake: Floats
    gear: NDArray[np.int64]
    phase: NDArray[np.str_]
    braking: Mask
    parked: Mask


def settle(
    truck: Truck,
    route: Route,
    course: Course,
    effects: tuple[Effect, ...],
    actions: Mapping[str, Action],
    ledgers: Ledgers,
) -> Truth:
    """Compute the true quantities of a drive.

    Parameters
    ----------
    truck, route, course
        Truck, its road, and its course on the road.
    effects, actions
        Requested effects, and acting effects by name.
    ledgers
        Force [N], power [W] or inertia [kg] of each effect at every step, by (name, kind).
    """
    s, v, engine_speed = course.s, course.v, course.engine_speed
    along_road = np.arange(len(route.grade)) * GRADE_SPACING
    along_bends = np.arange(len(route.curvature)) * CURVE_SPACING
    curvature = np.interp(s, along_bends, route.curvature)
    altitude = np.interp(s, along_road, route.altitude)
    limit = sum(action.retarder for action in actions.values())
    retarder = np.where(v > RETARDER_SPEED, np.minimum(course.brake, limit), 0.0)
    brake = course.brake - retarder
    braking = course.braking & ((retarder == 0.0) | (brake > 0.0))

    power = _wheel_powers(truck, route, course, ledgers)
    if limit:
        power["retarder_use"] = retarder * v
    reading = Reading(t=course.t, v=v, a=course.a, torque=course.torque, engine_speed=engine_speed)
    for name, action in actions.items():
        if action.reading is not None:
            read = action.reading(reading)
            power[name] = _gap(truck, read) - _gap(truck, reading)
            reading = read
    temperature = [action.temperature(course.t) for action in actions.values() if action.temperature is not None]
    fans = [action.fan for action in actions.values() if action.fan]
    runs = np.array(fans[0]) if fans else np.zeros(len(s), bool)
    return Truth(
        truck=truck,
        t=course.t,
        s=s,
        v=v,
        a=course.a,
        torque=course.torque,
        engine_speed=engine_speed,
        brake=brake,
        retarder=retarder,
        gear=course.gear,
        engaged=(course.phase == Phase.DRIVE.value) | (course.phase == Phase.UNLOAD.value),
        shifting=(course.phase == Phase.UNLOAD.value) | (course.phase == Phase.NEUTRAL.value),
        braking=braking,
        parked=course.parked,
        grade=np.interp(s, along_road, route.grade),
        altitude=altitude,
        heading=np.interp(s, along_bends, route.heading),
        yaw_rate=v * curvature,
        lateral_acceleration=v * v * curvature,
        ambient_temperature=temperature[0] if temperature else np.full(len(s), STANDARD_TEMPERATURE),
        coolant_temperature=_coolant(truck, course, actions),
        pressure=pressure_at(altitude),
        fan_speed=FAN_SPEED * np.where(runs, 1.0, FAN_SLIP),
        reading=reading,
        effects=effects,
        active={name: action.active for name, action in actions.items() if action.active},
        effect_power=power,
    )


def _gap(truck: Truck, read: Reading) -> Floats:
    """Power by the readings less the road load of the plain truck [W] (n,)."""
    return read.power - (truck.A + truck.C * read.v**2 + truck.mass * read.a) * read.v


def _wheel_powers(truck: Truck, route: Route, course: Course, ledgers: Ledgers) -> dict[str, Floats]:
    """Power at the crank [W] (n,) that each physical effect requires, by name."""
    v = course.v
    per_unit = {"force": v, "power": np.ones(len(v)), "inertia": course.a * v}
    powers: dict[str, Floats] = {}
    for (name, kind), ledger in ledgers.items():
        powers[name] = powers.get(name, 0.0) + ledger * per_unit[kind]
    slope = truck.mass * STANDARD_GRAVITY * route.grade / np.hypot(1.0, route.grade)
    if slope.any():
        powers["grade"] = np.interp(course.s, np.arange(len(slope)) * GRADE_SPACING, slope) * v
    if truck.efficiency != 1.0:
        crank = course.torque * course.engine_speed
        accessories = sum(ledger for (_, kind), ledger in ledgers.items() if kind == "power")
        traction = crank - accessories
        powers["driveline_efficiency"] = np.where(
            traction > 0.0, traction * (1.0 - truck.efficiency), traction * (1.0 - 1.0 / truck.efficiency)
        )
    return powers


def _coolant(truck: Truck, course: Course, actions: Mapping[str, Action]) -> Floats:
    """Temperature of the coolant [K] (n,): that which switched a fan, else that of a clean radiator on a cool day."""
    for action in actions.values():
        if action.coolant:
            return np.array(action.coolant)
    load = np.maximum(course.torque * course.engine_speed, 0.0) / cruise_power(truck)
    return THERMOSTAT + low_passed(COOL_DAY_RISE * load, 0.0, STEP, COOLANT_TIME)

"""A drive in time: forces move the truck, step by step.

State: position s [m], speed v [m/s], torque of the engine at the clutch T [N.m], brake force [N]. Newton's second law

    (m + inertia) dv/dt = T G - brake - A - C v^2 - m g sin(theta) - forces,      G = engine turns per way [rad/m]

is integrated with Heun's method (second order), torque and brake pressure by first-order lags; inertia and forces are
those of the effects at work. While the clutch is open, slips or between two gears the engine turns freely, and its
power is not that at the wheels.
"""

from collections.abc import Iterable
from math import exp

import numpy as np

from estimator.simulation.accounts import Course, settle
from estimator.simulation.driver import BRAKE_THRESHOLD, PERIOD, Driver
from estimator.simulation.effects.catalogue import start_all
from estimator.simulation.effects.effect import Effect
from estimator.simulation.gearbox import Gearbox, Phase
from estimator.simulation.moment import STEP, Moment
from estimator.simulation.route import GRADE_SPACING, Route
from estimator.simulation.truck import Truck
from estimator.simulation.truth import Truth
from estimator.units import STANDARD_GRAVITY

ENGINE_LAG = 0.25  # s, torque behind the pedal
UNLOAD_LAG = 0.07  # s, torque taken away for a shift
BRAKE_LAG = 0.25  # s, air brakes
DECISION_STEPS = round(PERIOD / STEP)


def drive(
    truck: Truck,
    route: Route,
    duration: float,
    rng: np.random.Generator,
    effects: Iterable[Effect] = (),
) -> Truth:
    """Drive ``truck`` along ``route`` for ``duration`` [s] with ``effects``; at the road's end it stands.

    Raises
    ------
    InputError
        There is no such effect, or none of that magnitude.
    """
    driver_rng, gearbox_rng, effects_rng = rng.spawn(3)
    asked = tuple(effects)
    actions, route = start_all(asked, truck, route, duration, effects_rng)
    driver = Driver(truck, route, duration, driver_rng)
    gearbox = Gearbox(truck, gearbox_rng)
    mass, A, C, efficiency = truck.mass, truck.A, truck.C, truck.efficiency
    slope_force = (mass * STANDARD_GRAVITY * route.grade / np.hypot(1.0, route.grade)).tolist()
    engine_gain, unload_gain, brake_gain = (1.0 - exp(-STEP / lag) for lag in (ENGINE_LAG, UNLOAD_LAG, BRAKE_LAG))
    threshold = BRAKE_THRESHOLD * mass

    steps = round(duration / STEP)
    speeds, places, accelerations, torques, engine_speeds, brakes = ([0.0] * steps for _ in range(6))
    gears, phases = [0] * steps, [Phase.OPEN] * steps
    braking_at, parked_at = [False] * steps, [False] * steps

    now = Moment()
    ledgers: dict[tuple[str, str], list[float]] = {}
    forces, powers, inertias = (
        [
            (work, ledgers.setdefault((name, kind), [0.0] * steps))
            for name, action in actions.items()
            if (work := getattr(action, kind)) is not None
        ]
        for kind in ("force", "power", "inertia")
    )
    acting = bool(ledgers)
    s = v = torque = brake = load = auxiliary = added = a = 0.0
    moved = mass
    braking = True
    demand = driver.act(0.0, s, v, a, holding=False)
    for k in range(steps):
        t = k * STEP
        gearbox.step(t, STEP, v, demand.force, load)
        phase, gearing, engine_speed = gearbox.phase, gearbox.gearing, gearbox.engine_speed
        coupled = phase is Phase.DRIVE or phase is Phase.UNLOAD or phase is Phase.SLIP
        if not coupled:
            torque = 0.0
        if acting:
            now.t, now.s, now.v, now.a, now.force, now.engine_speed = t, s, v, a, torque * gearing, engine_speed
            now.gearing, now.gear, now.closed = gearing, gearbox.gear, coupled and phase is not Phase.SLIP
            now.brake_light = False
            watts, added, moved = 0.0, 0.0, mass
            for work, ledger in powers:
                ledger[k] = x = work(now)
                watts += x
            for work, ledger in forces:
                ledger[k] = x = work(now)
                added += x
            for work, ledger in inertias:
                ledger[k] = x = work(now)
                moved += x
            auxiliary = watts / engine_speed

        # forces now
        cell = s / GRADE_SPACING
        i = int(cell)
        slope = slope_force[i] + (cell - i) * (slope_force[i + 1] - slope_force[i])
        holding_back = A + slope + added
        lever = gearing * efficiency if torque > 0.0 else gearing / efficiency
        a = (torque * lever - brake - holding_back - C * v * v) / moved
        if v == 0.0 and a < 0.0:
            a = 0.0

        speeds[k], places[k], accelerations[k], torques[k] = v, s, a, torque + auxiliary
        engine_speeds[k], brakes[k], gears[k], phases[k] = engine_speed, brake, gearbox.gear, phase
        braking_at[k], parked_at[k] = braking or now.brake_light, demand.parked

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
        next_a = (next_torque * lever - next_brake - holding_back - C * guess * guess) / moved
        next_v = v + 0.5 * STEP * (a + next_a)
        if next_v <= 0.0 or (v == 0.0 and a <= 0.0 and next_a <= 0.0):
            next_v = 0.0
        s += 0.5 * STEP * (v + next_v)
        v, torque, brake = next_v, next_torque, next_brake

    course = Course(
        t=STEP * np.arange(steps, dtype=np.float64),
        s=np.array(places),
        v=np.array(speeds),
        a=np.array(accelerations),
        torque=np.array(torques),
        engine_speed=np.array(engine_speeds),
        brake=np.array(brakes),
        gear=np.array(gears),
        phase=np.array([phase.value for phase in phases]),
        braking=np.array(braking_at),
        parked=np.array(parked_at),
    )
    return settle(truck, route, course, asked, actions, {key: np.array(ledger) for key, ledger in ledgers.items()})

"""Integration of a drive in time.

State: position s [m], speed v [m/s], torque of the engine at the clutch T [N.m], brake force [N]. Newton's second law

    (m + inertia) dv/dt = T G - brake - A - C v^2 - m g sin(theta) - forces,      G = engine turns per way [rad/m]

is integrated by Heun's method (second order). Torque and brake force follow by first-order lags. Inertia and forces are
those of the acting effects. While the clutch is open or slips, and between two gears, the engine turns freely, and its
power is not that at the wheels.
"""

from collections.abc import Callable, Iterable, Mapping
from math import exp

import numpy as np

from estimator.signals import Floats
from estimator.simulation.accounts import Course, settle
from estimator.simulation.driver import BRAKE_THRESHOLD, PERIOD, Driver
from estimator.simulation.effects.catalogue import start_all
from estimator.simulation.effects.effect import Effect
from estimator.simulation.gearbox import Gearbox, Phase
from estimator.simulation.moment import STEP, Action, Moment
from estimator.simulation.route import GRADE_SPACING, Route
from estimator.simulation.truck import Truck
from estimator.simulation.truth import Truth
from estimator.units import STANDARD_GRAVITY

ENGINE_LAG = 0.25  # s, torque behind the pedal
UNLOAD_LAG = 0.07  # s, torque taken away for a shift
BRAKE_LAG = 0.25  # s, air brakes
ENGINE_GAIN, UNLOAD_GAIN, BRAKE_GAIN = (1.0 - exp(-STEP / lag) for lag in (ENGINE_LAG, UNLOAD_LAG, BRAKE_LAG))  # a step
DECISION_STEPS = round(PERIOD / STEP)

Work = tuple[Callable[[Moment], float], list[float]]  # force, power or inertia of an effect, and its value of each step


def drive(
    truck: Truck,
    route: Route,
    duration: float,
    rng: np.random.Generator,
    effects: Iterable[Effect] = (),
) -> Truth:
    """Drive ``truck`` along ``route`` for ``duration`` [s] with ``effects``; it stops at the end of the road.

    Raises
    ------
    InputError
        An effect is unknown, or its magnitude is impossible.
    """
    driver_rng, gearbox_rng, effects_rng = rng.spawn(3)
    asked = tuple(effects)
    actions, route = start_all(asked, truck, route, duration, effects_rng)
    steps = round(duration / STEP)
    works = _Works(actions, steps)
    motion = _Motion(truck, route, Driver(truck, route, duration, driver_rng), Gearbox(truck, gearbox_rng), works)
    notes = _Notes(steps)
    for k in range(steps):
        motion.accelerate(k)
        notes.add(k, motion)
        motion.move(k)
    return settle(truck, route, notes.course(), asked, actions, works.ledgers())


class _Works:
    """Acting effects, with a ledger of the force, power or inertia of each.

    Parameters
    ----------
    actions
        Acting effects by name.
    steps
        Length of the drive in steps.
    """

    def __init__(self, actions: Mapping[str, Action], steps: int) -> None:
        self._ledgers: dict[tuple[str, str], list[float]] = {}
        self._forces, self._powers, self._inertias = (
            [
                (work, self._ledgers.setdefault((name, kind), [0.0] * steps))
                for name, action in actions.items()
                if (work := getattr(action, kind)) is not None
            ]
            for kind in ("force", "power", "inertia")
        )

    def __bool__(self) -> bool:
        """True if an effect acts on the motion."""
        return bool(self._ledgers)

    def act(self, k: int, now: Moment, mass: float) -> tuple[float, float, float]:
        """Power from the crank [W], force against the truck [N] and moving mass [kg] at step ``k``.

        ``mass`` [kg] is that of the truck without effects.
        """
        watts = _entered(self._powers, k, now, 0.0)
        force = _entered(self._forces, k, now, 0.0)
        return watts, force, _entered(self._inertias, k, now, mass)

    def ledgers(self) -> dict[tuple[str, str], Floats]:
        """Values (n,) at all steps, by name of the effect and kind: force [N], power [W] or inertia [kg]."""
        return {key: np.array(ledger) for key, ledger in self._ledgers.items()}


def _entered(works: list[Work], k: int, now: Moment, total: float) -> float:
    """Add the values of ``works`` at step ``k`` to ``total``, and enter each in its ledger."""
    for work, ledger in works:
        ledger[k] = x = work(now)
        total += x
    return total


class _Motion:
    """State of motion of the truck: `accelerate` computes the forces of a step, `move` integrates to the next.

    ``s`` [m], ``v`` [m/s], ``a`` [m/s^2], engine ``torque`` at the clutch, without ``auxiliary`` torque [N.m],
    ``brake`` force [N].

    Parameters
    ----------
    truck, route
        Truck, and its road.
    driver, gearbox
        Both in their state at the start of the drive.
    works
        Acting effects.
    """

    def __init__(self, truck: Truck, route: Route, driver: Driver, gearbox: Gearbox, works: _Works) -> None:
        self._truck = truck
        self._driver = driver
        self._works = works
        self._now = Moment()
        slope_force = truck.mass * STANDARD_GRAVITY * route.grade / np.hypot(1.0, route.grade)
        self._slope_force: list[float] = slope_force.tolist()
        self._threshold = BRAKE_THRESHOLD * truck.mass
        self.gearbox = gearbox
        self.s = self.v = self.a = self.torque = self.brake = self.auxiliary = 0.0
        self._load = 0.0  # torque over full-load torque
        self._added = 0.0  # N, forces of effects
        self._moved = truck.mass  # kg, with the inertia of effects
        self._holding_back = 0.0  # N, forces that do not change within a step
        self._coupled = False
        self._braking = True
        self.demand = driver.act(0.0, self.s, self.v, self.a, holding=False)

    @property
    def brake_light(self) -> bool:
        """True if the service brake, or an effect, lights the brake light."""
        return self._braking or self._now.brake_light

    def accelerate(self, k: int) -> None:
        """Compute gear, forces and acceleration at the beginning of step ``k``."""
        gearbox, v = self.gearbox, self.v
        gearbox.step(k * STEP, STEP, v, self.demand.force, self._load)
        phase = gearbox.phase
        self._coupled = phase is Phase.DRIVE or phase is Phase.UNLOAD or phase is Phase.SLIP
        if not self._coupled:
            self.torque = 0.0
        if self._works:
            self._let_effects_act(k)
        cell = self.s / GRADE_SPACING
        i = int(cell)
        below, above = self._slope_force[i], self._slope_force[i + 1]
        self._holding_back = self._truck.A + (below + (cell - i) * (above - below)) + self._added
        a = self._acceleration(self.torque, self.brake, v)
        self.a = 0.0 if v == 0.0 and a < 0.0 else a

    def move(self, k: int) -> None:
        """Integrate to step ``k + 1``: the driver's decision, pedals, and Heun's step of speed and position."""
        if k % DECISION_STEPS == 0:
            holding = self.gearbox.phase is Phase.UNLOAD or self.gearbox.phase is Phase.NEUTRAL
            self.demand = self._driver.act(k * STEP, self.s, self.v, self.a, holding=holding)
        torque, brake = self._pedals()
        v, a = self.v, self.a
        next_a = self._acceleration(torque, brake, v + STEP * a)
        next_v = v + 0.5 * STEP * (a + next_a)
        if next_v <= 0.0 or (v == 0.0 and a <= 0.0 and next_a <= 0.0):
            next_v = 0.0
        self.s += 0.5 * STEP * (v + next_v)
        self.v, self.torque, self.brake = next_v, torque, brake

    def _let_effects_act(self, k: int) -> None:
        """Compute power, force and inertia of the effects at step ``k``."""
        now, gearbox = self._now, self.gearbox
        now.t, now.s, now.v, now.a = k * STEP, self.s, self.v, self.a
        now.force, now.engine_speed = self.torque * gearbox.gearing, gearbox.engine_speed
        now.gearing, now.gear = gearbox.gearing, gearbox.gear
        now.closed = self._coupled and gearbox.phase is not Phase.SLIP
        now.brake_light = False
        watts, self._added, self._moved = self._works.act(k, now, self._truck.mass)
        self.auxiliary = watts / gearbox.engine_speed

    def _acceleration(self, torque: float, brake: float, v: float) -> float:
        """Acceleration [m/s^2] at a clutch torque [N.m], a brake force [N] and a speed [m/s]."""
        gearing, efficiency = self.gearbox.gearing, self._truck.efficiency
        lever = gearing * efficiency if torque > 0.0 else gearing / efficiency
        return (torque * lever - brake - self._holding_back - self._truck.C * v * v) / self._moved

    def _pedals(self) -> tuple[float, float]:
        """Clutch torque [N.m] and brake force [N] of the next step."""
        gearbox, force = self.gearbox, self.demand.force
        gain, target, drag = UNLOAD_GAIN, 0.0, 0.0
        if gearbox.phase is Phase.DRIVE or gearbox.phase is Phase.SLIP:
            gain = ENGINE_GAIN
            target, drag = self._engine_target(force)
        self._braking = force < drag - self._threshold or (self._braking and force < drag) or self.demand.standing
        brake_target = drag - force if self._braking else 0.0
        torque = self.torque + gain * (target - self.torque) if self._coupled else 0.0
        return torque, self.brake + BRAKE_GAIN * (brake_target - self.brake)

    def _engine_target(self, force: float) -> tuple[float, float]:
        """Torque [N.m] for a force at the wheels, within the engine's limits, and force of the engine's drag [N]."""
        truck, gearing, engine_speed = self._truck, self.gearbox.gearing, self.gearbox.engine_speed
        full = truck.max_torque(engine_speed) - self.auxiliary
        drag = -truck.friction_torque(engine_speed) if self.gearbox.phase is Phase.DRIVE else 0.0
        target = force / gearing
        if target > full:
            target = full
            self._driver.limit_force(full * gearing)
        elif target < drag:
            target = drag
        self._load = max(self.torque, 0.0) / max(full, 1.0)
        return target, drag * gearing


class _Notes:
    """Record of the course at the beginning of each of ``steps`` steps."""

    def __init__(self, steps: int) -> None:
        self._v, self._s, self._a, self._torque, self._engine_speed, self._brake = ([0.0] * steps for _ in range(6))
        self._gear, self._phase = [0] * steps, [Phase.OPEN] * steps
        self._braking, self._parked = [False] * steps, [False] * steps

    def add(self, k: int, motion: _Motion) -> None:
        """Record step ``k``."""
        gearbox = motion.gearbox
        self._v[k], self._s[k], self._a[k], self._brake[k] = motion.v, motion.s, motion.a, motion.brake
        self._torque[k], self._engine_speed[k] = motion.torque + motion.auxiliary, gearbox.engine_speed
        self._gear[k], self._phase[k] = gearbox.gear, gearbox.phase
        self._braking[k], self._parked[k] = motion.brake_light, motion.demand.parked

    def course(self) -> Course:
        """Recorded course, as arrays (n,)."""
        return Course(
            t=STEP * np.arange(len(self._v), dtype=np.float64),
            s=np.array(self._s),
            v=np.array(self._v),
            a=np.array(self._a),
            torque=np.array(self._torque),
            engine_speed=np.array(self._engine_speed),
            brake=np.array(self._brake),
            gear=np.array(self._gear),
            phase=np.array([phase.value for phase in self._phase]),
            braking=np.array(self._braking),
            parked=np.array(self._parked),
        )

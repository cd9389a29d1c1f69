"""Automated 12-speed gearbox with a dry clutch: shift decisions, and coupling of the engine during shifts."""

from enum import Enum

import numpy as np

from estimator.simulation.truck import GEARS, RPM, Truck

LAUNCH_SPEED = 750.0 * RPM  # rad/s of the engine while the clutch slips
ROLLING_SPEED = 1100.0 * RPM  # rad/s wanted of the engine when a rolling truck is put into gear
LOW_GEARS = 5  # gears that are pulled out further and left two at a time
SHIFT_PAUSE = 2.5  # s between two gear changes
LOW_SHIFT_PAUSE = 1.2  # s, in low gears
UNLOAD_TIME = 0.25, 0.4  # s to take the torque away before a gear is left
NEUTRAL_TIME = 0.35, 0.75  # s without a gear


class Phase(Enum):
    """Coupling of the engine to the wheels."""

    DRIVE = "drive"  # clutch closed
    UNLOAD = "unload"  # clutch closed, torque goes to zero before a shift
    NEUTRAL = "neutral"  # between two gears
    SLIP = "slip"  # clutch slips while moving off
    OPEN = "open"  # clutch open: standing, or too slow for the gear


class Gearbox:
    """Gear, clutch and engine speed of a truck.

    ``gear`` is the engaged gear, or the next one during a shift. ``gearing`` [rad/m] changes when the old gear is left.
    ``engine_speed`` is in [rad/s].
    """

    def __init__(self, truck: Truck, rng: np.random.Generator) -> None:
        self._truck = truck
        self._rng = rng
        self._gearings = [0.0, *(truck.gearing(gear) for gear in range(1, GEARS + 1))]
        self._slowest = 1.02 * truck.idle_speed  # rad/s with the clutch closed
        self._until = 0.0
        self._pause_until = 0.0
        self.phase = Phase.OPEN
        self.gear = truck.start_gear
        self.gearing = self._gearings[self.gear]
        self.engine_speed = truck.idle_speed

    def step(self, t: float, dt: float, v: float, force: float, load: float) -> None:
        """Advance to time ``t`` [s].

        Parameters
        ----------
        t, dt
            Time, and time since the last step [s].
        v
            Vehicle speed [m/s].
        force
            Force that the driver demands [N].
        load
            Engine torque over full-load torque [1].
        """
        phase = self.phase
        synchronous = self.gearing * v
        if phase is Phase.DRIVE:
            self.engine_speed = synchronous
            if synchronous < self._slowest:
                self.phase = Phase.OPEN
            elif t >= self._pause_until:
                self._consider_shift(t, synchronous, v, load, braking=force < -0.3 * self._truck.mass)
        elif phase is Phase.UNLOAD:
            self.engine_speed = synchronous
            if t >= self._until or synchronous < self._slowest:
                self.phase = Phase.NEUTRAL
                self._until = t + self._interruption(NEUTRAL_TIME)
                self.gearing = self._gearings[self.gear]
        elif phase is Phase.NEUTRAL:
            self.engine_speed += dt / 0.12 * (max(synchronous, self._truck.idle_speed) - self.engine_speed)
            if t >= self._until and synchronous < self._slowest:
                self.phase = Phase.OPEN
            elif t >= self._until:
                self.phase = Phase.DRIVE
                self.engine_speed = synchronous
                self._pause_until = t + (LOW_SHIFT_PAUSE if self.gear <= LOW_GEARS else SHIFT_PAUSE)
        elif phase is Phase.SLIP:
            self.engine_speed += dt / 0.3 * (LAUNCH_SPEED - self.engine_speed)
            if force < 0.0:
                self.phase = Phase.OPEN
            elif synchronous >= self.engine_speed:
                self.phase = Phase.DRIVE
                self.engine_speed = synchronous
        else:
            self.engine_speed += dt / 0.4 * (self._truck.idle_speed - self.engine_speed)
            if force > 0.0:
                self._select(self._gear_for(v, ROLLING_SPEED))
                self.phase = Phase.SLIP
            elif synchronous > 2.0 * self._slowest:  # rolls downhill
                self._select(self._gear_for(v, ROLLING_SPEED))
                self.phase = Phase.NEUTRAL
                self._until = t + self._rng.uniform(*NEUTRAL_TIME)

    def _consider_shift(self, t: float, engine_speed: float, v: float, load: float, braking: bool) -> None:
        gear = self.gear
        low = gear <= LOW_GEARS
        upper = (1600.0 if low else 1380.0 + 320.0 * load) * RPM
        lower = (900.0 if braking else 920.0 + 170.0 * load) * RPM
        if engine_speed > (0.9 * self._truck.max_speed if braking else upper) and gear < GEARS:
            skip = low and self._gearings[gear + 2] * v > 970.0 * RPM
            self._shift(t, gear + 1 + skip)
        elif engine_speed < lower and gear > self._truck.start_gear:
            wanted = self._gear_for(v, (1250.0 if braking else 1150.0 + 150.0 * load) * RPM)
            if wanted < gear:
                self._shift(t, wanted)

    def _shift(self, t: float, gear: int) -> None:
        self.gear = gear
        self.phase = Phase.UNLOAD
        self._until = t + self._interruption(UNLOAD_TIME)

    def _interruption(self, times: tuple[float, float]) -> float:
        """Duration [s] for which a part of a gear change interrupts the traction."""
        return 0.0 if self._truck.shifts_under_power else self._rng.uniform(*times)

    def _select(self, gear: int) -> None:
        self.gear = gear
        self.gearing = self._gearings[gear]

    def _gear_for(self, v: float, engine_speed: float) -> int:
        """Highest gear that turns the engine at least at ``engine_speed`` [rad/s] at ``v`` [m/s], or the start gear."""
        lowest = self._truck.start_gear
        return next((gear for gear in range(GEARS, lowest, -1) if self._gearings[gear] * v >= engine_speed), lowest)

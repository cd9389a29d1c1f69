"""Driver model: follows the speed of the road, brakes for slower sections and stops ahead, and operates the pedals.

The driver reacts to speed and acceleration only. The force at the wheels changes until the acceleration ``a`` is the
wanted one, ``dF/dt = m (a_wanted - a) / reaction time``. The driver therefore needs no model of the road load.
"""

from dataclasses import dataclass

import numpy as np

from estimator.signals import Floats
from estimator.simulation.noise import correlated, smooth
from estimator.simulation.route import Route
from estimator.simulation.truck import Truck

PERIOD = 0.1  # s between two decisions
GRID = 2.0  # m, resolution of the speeds seen ahead
SPEED_GAIN = 0.5  # 1/s, wanted acceleration per speed error
REACTION_TIME = 0.6  # s
MAX_BRAKING = 2.0  # m/s^2
CREEP = 0.4  # m/s, below which the driver brakes to a standstill at a stop
STOP_ZONE = 6.0  # m before the stop line
BRAKE_THRESHOLD = 0.15  # m/s^2 beyond engine drag before the foot goes to the brake
PARKING_DWELL = 25.0  # s, a standstill this long is spent on the parking brake


@dataclass(frozen=True, slots=True)
class Demand:
    """Demand of the driver: force at the wheels [N], whether the truck is held at a standstill, and whether parked."""

    force: float
    standing: bool
    parked: bool


class Driver:
    """Driver of one truck on one road.

    Parameters
    ----------
    truck, route
        Truck, and its road.
    duration
        Length of the drive [s].
    rng
        Source of randomness for the driver's parameters and the traffic.
    """

    def __init__(self, truck: Truck, route: Route, duration: float, rng: np.random.Generator) -> None:
        decisions = int(duration / PERIOD) + 2
        self._mass = truck.mass
        self._launch = float(rng.uniform(0.8, 1.1))  # m/s^2
        self._seen: list[float] = speeds_ahead(route, rng.uniform(0.1, 0.25), rng.uniform(0.4, 0.7)).tolist()
        self._traffic: list[float] = _traffic(decisions, rng).tolist()
        self._wobble: list[float] = correlated(decisions, 0.03, 20.0, rng).tolist()  # m/s^2
        self._stops: list[tuple[float, float]] = list(
            zip(route.stop_position.tolist(), route.stop_dwell.tolist(), strict=True)
        )
        self._next_stop = 0
        self._cleared = 0.0  # m, road before this is behind the driver
        self._standing = True
        self._parked = True
        self._leave_at = rng.uniform(5.0, 15.0)
        self._force = 0.0
        self._decision = -1

    def act(self, t: float, s: float, v: float, a: float, holding: bool) -> Demand:
        """Decide at time ``t`` [s], position ``s`` [m], speed ``v`` [m/s], acceleration ``a`` [m/s^2].

        ``holding``: a gear change interrupts the traction, and the demand does not change.
        """
        self._decision += 1
        stop, dwell = self._stops[self._next_stop]
        if self._standing:
            if t < self._leave_at:
                return Demand(-self._mass, True, self._parked)
            self._standing = False
            self._force = 0.0
        elif v == 0.0 and stop - s < STOP_ZONE:
            self._standing = True
            self._leave_at = t + dwell
            self._parked = dwell > PARKING_DWELL
            self._cleared = max(s, stop) + GRID
            self._next_stop = min(self._next_stop + 1, len(self._stops) - 1)
            return Demand(-self._mass, True, self._parked)
        if not holding:
            wanted = self._wanted_acceleration(s, v, stop)
            limit = MAX_BRAKING * self._mass
            self._force += PERIOD / REACTION_TIME * self._mass * (wanted - a)
            self._force = min(max(self._force, -limit), limit)
        return Demand(self._force, False, False)

    def limit_force(self, force: float) -> None:
        """Limit the demand to the ``force`` [N] of the engine at full load."""
        self._force = min(self._force, force)

    def _wanted_acceleration(self, s: float, v: float, stop: float) -> float:
        if v < CREEP and stop - s < STOP_ZONE:
            return -0.6
        here = max(s, self._cleared)
        ahead = min(here + v / SPEED_GAIN, stop)
        seen = self._seen
        speed = min(seen[int(here / GRID)] if here < stop else 0.0, seen[int(ahead / GRID)] if ahead < stop else 0.0)
        wanted = SPEED_GAIN * (speed * self._traffic[self._decision] - v) + self._wobble[self._decision]
        return min(max(wanted, -MAX_BRAKING), self._launch / (1.0 + v / 8.0))


def speeds_ahead(route: Route, easing: float, stopping: float) -> Floats:
    """Highest speed [m/s] (n,) every ``GRID`` metres from which the limits ahead are reached by gentle braking.

    Parameters
    ----------
    route
        Road ahead.
    easing, stopping
        Decelerations towards slower sections and towards stops [m/s^2].
    """
    distance = np.arange(0.0, route.length + 2 * GRID, GRID)
    section = np.searchsorted(route.section_start, distance, side="right") - 1
    sections = route.section_speed[section] ** 2
    stops = np.full(len(distance), np.inf)
    stops[(route.stop_position / GRID).astype(int)] = 0.0
    squares = np.minimum(_reachable(sections, distance, easing), _reachable(stops, distance, stopping))
    speeds: Floats = np.sqrt(squares)
    return speeds


def _reachable(squares: Floats, distance: Floats, deceleration: float) -> Floats:
    """Squared speeds from which every later limit is met at a deceleration [m/s^2]."""
    potential = 2.0 * deceleration * distance
    lowest: Floats = np.minimum.accumulate((squares + potential)[::-1])[::-1] - potential
    return np.maximum(lowest, 0.0)


def _traffic(decisions: int, rng: np.random.Generator) -> Floats:
    """Share [1] of the road's speed that traffic allows, for every decision."""
    slow = 0.96 + smooth(decisions, 0.025, 12.0 / PERIOD, rng)
    jam = smooth(decisions, 1.0, 8.0 / PERIOD, rng)
    allowed: Floats = np.clip(slow - 0.25 * np.clip(jam - 1.3, 0.0, 1.0), 0.6, 1.0)
    return allowed

"""Whether the speed is in its unit, by what the bus itself says: no DBC is believed.

A speed that is read f times too large fits the model with a mass f^2 times too small, and no residual tells. So it is
compared with other signals of the same motion, where the bus has them: the speed by satellites, the way between
positions, the wheels, yaw rate and lateral acceleration. Any of these decides alone, and its ratio is the factor.
Without them there are limits that no vehicle passes: of speed, turns of the engine per distance, and grip of tyres.

What lies within the limits, but is unusual in several respects at once, is judged by `usual_vehicles`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimator.checkpoint.validation import State, array, substate
from estimator.estimation.log_counts import LogCounts
from estimator.preparation.admission import is_shifting
from estimator.samples import STEP, Rows
from estimator.settings import SignalPaths
from estimator.signals import Floats, Role
from estimator.units import EARTH_RADIUS

MIN_ROWS = 600  # 1 min of rows, for a comparison
MIN_LIMIT_ROWS = 100  # 10 s of rows beyond a limit
MIN_COMPARED_SPEED = 5.0  # m/s: an error of a GPS of 0.5 m/s is within MAX_DIFFERENCE
MAX_DIFFERENCE = 0.1  # of two speeds: worn tyres make 3 %, slip on snow a few, units at least 60 %
MAX_WAY_DIFFERENCE = 0.25  # of the way driven and the straight line: the chord of 10 s of a roundabout is 0.8 of it
WAY_ROWS = 100  # 10 s: 50 m and more, against 3 m of noise of a position
UNITS = {  # speed as it is read over the true one: the unit that it is in, and the one it is labelled with
    3.6: "km/h, labelled m/s",
    2.237: "mph, labelled m/s",
    1.609: "km/h, labelled mph",
    1 / 1.609: "mph, labelled km/h",
    1 / 2.237: "m/s, labelled mph",
    1 / 3.6: "m/s, labelled km/h",
}
UNIT_TOLERANCE = 0.05  # relative, by which a measured ratio may differ from one of UNITS
MAX_SPEED = 120.0  # m/s, 432 km/h: the fastest cars on roads reach 490 km/h for a moment
MAX_GRIP = 12.0  # m/s^2 over a second: racing tyres on dry asphalt, without a wing
MAX_BEYOND_GRIP = 0.01  # of the rows on the move: locked and spinning wheels
SECOND = round(1 / STEP)  # rows
# rad/m of the engine per distance in the highest gear. Below: it turns slower than a wheel of 1.1 m, as no drive train
# is geared. Above: 16,000 rpm at 21 m/s.
MIN_GEARING, MAX_GEARING = 1.8, 80.0
HIGHEST_GEAR = 0.1  # quantile of the turns per distance: mostly that of the highest gear, whatever the gears
SINGLE = 0.1  # by which turns per distance at a walking pace and in the highest gear differ where there is one ratio
WALKING = 1.0, 3.0  # m/s, where a combustion engine slips its clutch or turns three times as fast as in a high gear
MIN_WALKING_ROWS = 50  # 5 s
MAX_LATERAL_DIFFERENCE = 0.25  # of speed times yaw rate and lateral acceleration: a body that rolls feels 0.1 more
MIN_LATERAL = 0.5  # m/s^2, from which they are compared: a slope across the road gives 0.2
COMPARED = {  # with what, by the role that it is known by, and by how much it may differ
    Role.GPS_SPEED: ("the GPS speed", MAX_DIFFERENCE),
    Role.WHEEL_SPEEDS: ("the mean of the wheels", MAX_DIFFERENCE),
    Role.LATITUDE: ("the way between positions per time", MAX_WAY_DIFFERENCE),
    Role.YAW_RATE: ("the lateral acceleration per yaw rate", MAX_LATERAL_DIFFERENCE),
}


@dataclass(frozen=True, slots=True)
class Motion:
    """Statistics of the speed and gears so far.

    ``fastest`` speed, exceeded for 10 s and 1 % of the drive [m/s]; ``gearing`` turns of the engine per
    distance in the highest gear [rad/m], None where they are not known; ``is_single`` whether that is the only gear, as
    of an electric motor; ``felt`` change of the acceleration by the accelerometer over that of the speed [1], None
    where there is none.
    """

    fastest: float
    gearing: float | None
    is_single: bool
    felt: float | None


class ScaleCheck:
    """Compares the speed with all that measures the same motion.

    Parameters
    ----------
    names
        Signal that each role is bound to, for the messages.
    """

    def __init__(self, names: Mapping[str, SignalPaths]) -> None:
        self._names = names
        self._ratios = {role: LogCounts() for role in COMPARED}
        self._speed, self._changes, self._gearing, self._walking = (LogCounts() for _ in range(4))
        self._felt = np.zeros(
            3
        )  # seconds, and sums over them of changes of acceleration: squared, and times those felt

    def add(self, rows: Rows) -> None:
        """Take the next rows."""
        if not len(rows):
            return
        speed = np.where(rows.frozen, np.nan, rows.speed)
        blank = np.full(len(rows), np.nan)
        with np.errstate(invalid="ignore", divide="ignore"):
            fast = np.where(speed > MIN_COMPARED_SPEED, speed, np.nan)
            for role in (Role.GPS_SPEED, Role.WHEEL_SPEEDS):
                other = rows.context.get(role, blank)
                self._ratios[role].add(fast / np.where(other > 0, other, np.nan))
            self._ratios[Role.LATITUDE].add(_over_way(rows, speed))
            sideways = rows.context.get(Role.LATERAL_ACCELERATION, blank)
            turning = fast * rows.context.get(Role.YAW_RATE, blank)
            self._ratios[Role.YAW_RATE].add(
                np.abs(turning) / np.where(np.abs(sideways) > MIN_LATERAL, np.abs(sideways), np.nan)
            )
            self._speed.add(fast)
            self._changes.add(np.abs(fast[SECOND:] - speed[:-SECOND]))
            turns = rows.context.get(Role.ENGINE_SPEED, blank) / speed
            driving = (rows.power > 0) & ~is_shifting(rows)
            self._gearing.add(turns[driving & (speed > MIN_COMPARED_SPEED)])
            self._walking.add(turns[driving & (speed > WALKING[0]) & (speed < WALKING[1])])
        self._felt += _felt(speed, rows.context.get(Role.LONGITUDINAL_ACCELERATION, blank))

    @property
    def motion(self) -> Motion | None:
        """Speed and gears so far; None before 10 s of them are known."""
        if len(self._speed) < MIN_LIMIT_ROWS:
            return None
        gearing = self._gearing.quantile(HIGHEST_GEAR) if len(self._gearing) >= MIN_LIMIT_ROWS else None
        is_single = False
        if gearing is not None and len(self._walking) >= MIN_WALKING_ROWS:
            is_single = abs(np.log(self._walking.quantile(0.5) / gearing)) < SINGLE
        seconds, squared, both = self._felt.tolist()
        felt = both / squared if seconds * SECOND >= MIN_ROWS and squared > 0 else None
        fastest = self._speed.quantile(1 - max(0.01, MIN_LIMIT_ROWS / len(self._speed)))
        return Motion(fastest, gearing, is_single, felt)

    @property
    def is_confirmed(self) -> bool:
        """Whether another signal of the same motion agrees with the speed; the worst is in `verdict`."""
        return any(len(ratios) >= MIN_ROWS for ratios in self._ratios.values()) and not self.verdict()

    def verdict(self) -> str:
        """The worst contradiction in words, with the signal and the factor that fits; empty where there is none."""
        for role, (other, limit) in COMPARED.items():
            ratios = self._ratios[role]
            if len(ratios) >= MIN_ROWS and abs(np.log(ratio := ratios.quantile(0.5))) > limit:
                return f"{self.signal} is {ratio:.3g} times {other}{self._name(role)}: {remedy(ratio, 'their units')}"
        return self._beyond_limits()

    def _beyond_limits(self) -> str:
        """A quantity that no vehicle has; empty where there is none."""
        motion, speed = self.motion, self.signal
        if motion is None:
            return ""
        if motion.fastest > MAX_SPEED:
            factor = motion.fastest / MAX_SPEED
            return (
                f"{speed} says {3.6 * motion.fastest:.0f} km/h: it reads at least {_excess(factor)} too large, "
                "check its unit"
            )
        if motion.gearing is not None and not MIN_GEARING < motion.gearing < MAX_GEARING:
            factor = max(MIN_GEARING / motion.gearing, motion.gearing / MAX_GEARING)
            large = "large" if motion.gearing < MIN_GEARING else "small"
            return (
                f"the engine turns {motion.gearing:.3g} rad per metre, in no vehicle less than {MIN_GEARING:g} or more "
                f"than {MAX_GEARING:g}: {speed} reads at least {_excess(factor)} too {large}, "
                f"or engine_speed{self._name(Role.ENGINE_SPEED)} is in another unit"
            )
        change = self._changes.quantile(1 - MAX_BEYOND_GRIP) if len(self._changes) >= MIN_LIMIT_ROWS else 0.0
        if change > MAX_GRIP:
            return (
                f"{speed} changes by {change:.3g} m/s in a second, tyres grip for {MAX_GRIP:g}: it reads at least "
                f"{_excess(change / MAX_GRIP)} too large, check its unit"
            )
        return ""

    @property
    def signal(self) -> str:
        """The speed and its signal, for messages."""
        role = Role.SPEED if Role.SPEED in self._names else Role.WHEEL_SPEEDS
        return f"{role.value.replace('_', ' ')}{self._name(role)}"

    def _name(self, role: Role) -> str:
        bound = self._names.get(role, [])
        return " (" + ", ".join([bound] if isinstance(bound, str) else bound) + ")" if bound else ""

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads."""
        return {
            "ratios": {role.value: ratios.state() for role, ratios in self._ratios.items()},
            "speed": self._speed.state(),
            "changes": self._changes.state(),
            "gearing": self._gearing.state(),
            "walking": self._walking.state(),
            "felt": self._felt.copy(),
        }

    def restore(self, state: State) -> None:
        """Take the state of another one.

        Raises
        ------
        StateError
            The state is not that of such a check.
        """
        ratios = substate(state, "ratios")
        for role, counts in self._ratios.items():
            counts.restore(substate(ratios, role.value))
        self._speed.restore(substate(state, "speed"))
        self._changes.restore(substate(state, "changes"))
        self._gearing.restore(substate(state, "gearing"))
        self._walking.restore(substate(state, "walking"))
        self._felt = array(state, "felt", (3,))


def _excess(factor: float) -> str:
    """A factor above 1 in words; a small one as a share, as it would be rounded to 1."""
    return f"{factor:.2g} times" if factor >= 1.1 else f"{100 * (factor - 1):.1g} %"


def remedy(ratio: float, what: str = "its unit") -> str:
    """Advice to check ``what``, for a speed that is read ``ratio`` times too large."""
    unit = next((text for factor, text in UNITS.items() if abs(ratio / factor - 1) < UNIT_TOLERANCE), "")
    return f"check {what}; a factor of {1 / ratio:.3g} would fit" + (f" (in {unit}?)" if unit else "")


def _over_way(rows: Rows, speed: Floats) -> Floats:
    """Way driven in WAY_ROWS over the straight line between positions there, where both are known."""
    if len(rows) <= WAY_ROWS or not rows.context.keys() >= {Role.LATITUDE, Role.LONGITUDE}:
        return np.empty(0)
    latitude, longitude = rows.context[Role.LATITUDE], rows.context[Role.LONGITUDE]
    north = EARTH_RADIUS * (latitude[WAY_ROWS:] - latitude[:-WAY_ROWS])
    east = EARTH_RADIUS * np.cos(latitude[WAY_ROWS:]) * (longitude[WAY_ROWS:] - longitude[:-WAY_ROWS])
    way = np.concatenate([[0.0], np.cumsum(speed * STEP)])
    driven = way[WAY_ROWS:-1] - way[: -WAY_ROWS - 1]
    straight = np.hypot(north, east)
    far = np.minimum(driven, straight) > WAY_ROWS * STEP * MIN_COMPARED_SPEED / 4
    ratio: Floats = np.where(far, driven, np.nan) / np.where(far, straight, np.nan)
    return ratio


def _felt(speed: Floats, acceleration: Floats) -> Floats:
    """Seconds of rows (n,) at which both are known, and sums (3,) over them, see `ScaleCheck`.

    Changes from second to second: the slope of the road, which the accelerometer feels too, changes more slowly.
    """
    seconds = len(speed) // SECOND
    v, felt = (each[: seconds * SECOND].reshape(seconds, SECOND).mean(axis=1) for each in (speed, acceleration))
    change, felt_change = np.diff((v[2:] - v[:-2]) / 2), np.diff(felt[1:-1])
    known = np.isfinite(change) & np.isfinite(felt_change)
    change, felt_change = change[known], felt_change[known]
    return np.array([known.sum(), change @ change, change @ felt_change])

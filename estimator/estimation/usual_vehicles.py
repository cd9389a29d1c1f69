"""Whether a vehicle is unusual in a way that a speed in the wrong unit explains.

With a speed read f times too large, power and force are what they are, so the fit gives

    m / f^2,   A / f,   C / f^3

and the engine seems to turn 1 / f times as far per distance. Each of rolling coefficient, drag area, turns, highest
speed and acceleration that is felt has a usual size among vehicles, with a spread that is not small: alone, none of
them tells a wrong unit from an unusual vehicle. Together they do. With the factors of units that are mistaken for each
other as hypotheses,

    log odds(f) = log P(f) + sum_i [log p_i(f) - log p_i(1)],   log p_i = -min(z_i^2, MAX_SDS^2) / 2

z_i being the distance of size i from the usual one, over the spread and the sd of the fit. A size is believed up to
MAX_SDS: then it is of a kind of vehicle that is not known here, and says nothing more. So one size alone never decides.
Without P(f), which is small, a unit is a doubt beside the estimate.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from estimator.estimation.scale_check import UNITS, Motion, remedy
from estimator.settings import Range
from estimator.signals import Floats
from estimator.units import STANDARD_GRAVITY

AIR_DENSITY = 1.2  # kg/m^3
CHANCE = 0.003  # of each of UNITS, before anything is known: a mistake in one of fifty bindings
MIN_LOG_ODDS = 3.0  # of a unit against none, from which the estimate is withheld, and of a doubt: 20 to 1
MAX_SDS = 3.0
HEAVY = 3500.0  # kg, from which a vehicle has tyres of trucks
ROLLING_OF_CARS, ROLLING_OF_TRUCKS, ROLLING_SPREAD = 0.011, 0.0065, 0.35  # ISO 28580 classes C1 and C3, and losses
# m^2 of drag area per kg up to the largest, of a vehicle as wide and as high as roads allow: 0.65 m^2 at 1.5 t, 5.5 m^2
# from 12.5 t on (VECTO's groups). Empty and laden vehicles, and wind, make the spread.
DRAG_AREA_PER_MASS, LARGEST_DRAG_AREA, DRAG_SPREAD = 0.44e-3, 5.5, 0.35
# rad/m in the highest gear: 1,200 rpm at 85 km/h of a truck to 2,500 rpm at 100 km/h of a car. A drive that stays slow
# does not reach that gear, and has more.
GEARING_OF_ENGINES, GEARING_SPREAD, GEARING_SPREAD_ABOVE = 6.5, 0.3, 0.7
GEARING_OF_MOTORS, MOTORS_SPREAD = 27.0, 0.3  # one ratio of 7 to 13 over a wheel of 0.3 to 0.37 m
FASTEST_OF_CARS, FASTEST_OF_TRUCKS, FASTEST_SPREAD = 50.0, 31.0, 0.1  # m/s that are exceeded for a minute by few
FELT, FELT_SPREAD = 1.1, 0.15  # over that of the wheels: the body pitches, the sensor is filtered (BMW i3: 0.9 to 1.27)
MAX_RELATIVE_SD = 0.5  # of A and C, from which a logarithm describes them badly
# Alone beyond all vehicles: the power of a racing car [W/kg], and the drag of a plate as wide and as high as roads
# allow, 2.6 m by 4.6 m, in a wind against it [m^2].
MAX_POWER_PER_MASS, MAX_DRAG_AREA = 1000.0, 16.0


@dataclass(frozen=True, kw_only=True)
class Size:
    """A vehicle by its drive alone: ``A`` [N], ``C`` [N s^2/m^2], ``mass`` [kg], ``sd`` of these (3,).

    ``power`` [W] is the largest that it held.
    """

    A: float
    C: float
    mass: float
    sd: Floats
    power: float

    @property
    def least_drag_area(self) -> float:
        """Drag area that it has at least [m^2]."""
        return 2 * (self.C - MAX_SDS * float(self.sd[1])) / AIR_DENSITY

    def scaled(self, f: float) -> "Size":
        """The size, if the speed is read ``f`` times too large."""
        return Size(
            A=self.A * f, C=self.C * f**3, mass=self.mass * f**2, sd=self.sd * [f, f**3, f**2], power=self.power
        )


@dataclass(frozen=True)
class Doubt:
    """A ``sentence`` on a vehicle that is unusual; empty if it is usual. ``is_certain``: no vehicle is like that."""

    sentence: str = ""
    is_certain: bool = False


def unusual(size: Size, motion: Motion | None, signal: str, masses: Range) -> Doubt:
    """Doubt about the unit of the speed, by the sizes of the vehicle.

    Parameters
    ----------
    size, motion
        Size of the vehicle, and statistics of its speed and gears; None if these are unknown.
    signal
        Signal of the speed, for the message.
    masses
        Masses that the configuration allows [kg].
    """
    if size.mass <= 0 or motion is None:
        return Doubt()
    plain = _log_density(size, motion, 1.0)
    gains = {f: _log_density(size, motion, f) - plain for f in UNITS if masses[0] <= size.mass * f**2 <= masses[1]}
    best = max(gains, key=lambda f: gains[f], default=1.0)
    gain = gains.get(best, -np.inf)
    is_beyond_all = size.power > MAX_POWER_PER_MASS * size.mass or size.least_drag_area > MAX_DRAG_AREA
    if not is_beyond_all and gain < MIN_LOG_ODDS:
        return Doubt()
    sizes = [
        f"{size.mass:,.0f} kg",
        f"rolling coefficient {100 * size.A / (size.mass * STANDARD_GRAVITY):.2g} %",
        f"drag area {2 * size.C / AIR_DENSITY:.2g} m²",
        f"{size.power / size.mass:.2g} W/kg",
        f"{3.6 * motion.fastest:.0f} km/h",
    ]
    if motion.gearing is not None:
        sizes.append(f"{motion.gearing:.2g} rad/m of the engine")
    wrong = f"{best:.3g} times too large" if best > 1 else f"{1 / best:.3g} times too small"
    guess = f"{signal} may read {wrong}" if gain > 0 else f"{signal} or the power is wrong"
    advice = remedy(best) if gain > 0 else "check their units"
    is_certain = is_beyond_all or np.log(CHANCE) + gain >= MIN_LOG_ODDS
    seldom = "no vehicle has" if is_certain else "few vehicles have"
    return Doubt(f"{seldom} these values together: {', '.join(sizes)}; {guess}: {advice}", bool(is_certain))


def _log_density(size: Size, motion: Motion, f: float) -> float:
    """Log density of all sizes, but for a constant, if the speed is read ``f`` times too large."""
    return sum(-min(z**2, MAX_SDS**2) / 2 for z in _distances(size.scaled(f), motion, f))


def _distances(size: Size, motion: Motion, f: float) -> Iterator[float]:
    """Yield the distance [sd] of each quantity from its usual value; ``size`` is scaled by ``f`` already."""
    is_heavy = size.mass > HEAVY
    if size.A > 0 and (relative := float(size.sd[0]) / size.A) < MAX_RELATIVE_SD:
        usual = ROLLING_OF_TRUCKS if is_heavy else ROLLING_OF_CARS
        yield float(np.log(size.A / (size.mass * STANDARD_GRAVITY) / usual) / np.hypot(ROLLING_SPREAD, relative))
    if size.C > 0 and (relative := float(size.sd[1]) / size.C) < MAX_RELATIVE_SD:
        usual = min(DRAG_AREA_PER_MASS * size.mass, LARGEST_DRAG_AREA)
        yield float(np.log(2 * size.C / AIR_DENSITY / usual) / np.hypot(DRAG_SPREAD, relative))
    if motion.gearing is not None and motion.is_single:
        yield float(np.log(motion.gearing * f / GEARING_OF_MOTORS) / MOTORS_SPREAD)
    elif motion.gearing is not None:
        above = float(np.log(motion.gearing * f / GEARING_OF_ENGINES))
        yield above / (GEARING_SPREAD_ABOVE if above > 0 else GEARING_SPREAD)
    fastest = FASTEST_OF_TRUCKS if is_heavy else FASTEST_OF_CARS
    yield max(float(np.log(motion.fastest / f / fastest)), 0.0) / FASTEST_SPREAD
    if motion.felt is not None and motion.felt > 0:
        yield float(np.log(motion.felt * f / FELT) / FELT_SPREAD)

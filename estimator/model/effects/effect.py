"""Effect that the road load lacks: its power as a function of measured quantities.

One object serves the diagnosis (does it act?), the streaming estimator (add it to the model) and the documentation.
"""

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass
from enum import StrEnum
from math import inf
from typing import Any

from estimator.signals import Floats, Quantity, Role

TYPICAL_MASS = 27e3  # kg, a loaded tractor and semi-trailer
USUAL_TO_LARGEST = 4.0  # largest magnitude over the usual one, where no other is known

Shape = Any  # parameter that an effect is non-linear in: a time constant [s], a direction [rad], a source, None
UsualMagnitude = Callable[[Floats], float]  # usual magnitude for a vehicle with road load [A, C, m]

SOURCES: dict[Quantity, tuple[Role, ...]] = {  # any one of the roles will do
    Quantity.ENGINE_SPEED: (Role.ENGINE_SPEED,),
    Quantity.GEAR: (Role.GEAR,),
    Quantity.HEADING: (Role.HEADING,),
    Quantity.LATERAL_ACCELERATION: (Role.LATERAL_ACCELERATION, Role.YAW_RATE),
    Quantity.FAN_SPEED: (Role.FAN_SPEED,),
    Quantity.BATTERY_CURRENT: (Role.BATTERY_CURRENT,),
    Quantity.BRAKE: (Role.BRAKE_SWITCH, Role.BRAKE_PEDAL),
    Quantity.CLIMB_BY_GRADE: (Role.GRADE,),
    Quantity.CLIMB_BY_ALTITUDE: (Role.ALTITUDE,),
    Quantity.CLIMB_BY_ACCELEROMETER: (Role.LONGITUDINAL_ACCELERATION,),
}

Context = Mapping[Quantity, Floats]


@dataclass(frozen=True, slots=True, kw_only=True)
class View:
    """Quantities that effects are computed from; all arrays (n,).

    ``t`` [s], ``v`` [m/s], ``a`` [m/s^2] as on level ground, ``P`` [W], ``density`` relative to its mean [1];
    ``road_load`` = [A, C, m] is the current estimate, for effects that scale with it.
    """

    t: Floats
    v: Floats
    a: Floats
    P: Floats
    density: Floats
    context: Context
    road_load: Floats
    duration: float = 0.0  # [s] that each of them is the mean of; 0: values at a time

    @property
    def A(self) -> float:
        """Rolling and friction force [N]."""
        return float(self.road_load[0])

    @property
    def C(self) -> float:
        """Aerodynamic coefficient [N s^2/m^2]."""
        return float(self.road_load[1])

    @property
    def m(self) -> float:
        """Mass [kg]."""
        return float(self.road_load[2])


@dataclass(frozen=True, slots=True, kw_only=True)
class AtRest:
    """Mean power [W] during a standstill, and its sd [W].

    ``engine_speed`` [rad/s] is 0 for a motor that stands too; ``elapsed`` [s] is the time since the drive began.
    """

    power: float
    sd: float
    engine_speed: float
    elapsed: float = 0.0


class Timing(StrEnum):
    """Kind of times at which an effect acts, if no signal shows them."""

    ALWAYS = "always"
    WINDOW = "window"  # once, from some time to another
    SWITCHING = "switching"  # on and off, again and again
    STEP = "step"  # from some standstill onwards


def by_mass(value: float) -> UsualMagnitude:
    """Usual magnitude in proportion to the mass; ``value`` is that of a truck of TYPICAL_MASS."""
    return lambda road_load: value * float(road_load[2]) / TYPICAL_MASS


def always(value: float) -> UsualMagnitude:
    """Usual magnitude ``value`` for all vehicles, for a magnitude that is relative."""
    return lambda road_load: value


@dataclass(frozen=True, kw_only=True)
class Effect:
    """Effect that the plain road load leaves out.

    Parameters
    ----------
    name
        Name in the configuration.
    equation, source
        Power that it adds to P, and its physical cause or reference.
    symbol, unit
        Symbol and unit of its magnitude.
    power
        Power [W] (n,) per unit of magnitude, given a `View` and one of the ``shapes``.
    usual_magnitude
        Usual magnitude for a vehicle with ``road_load`` = [A, C, m]: scale of its prior.
    max_size
        Largest plausible modulus of its coefficient; None: USUAL_TO_LARGEST times the usual magnitude.
    max_positive_size
        Largest plausible positive coefficient, where that is less than ``max_size``.
    positive
        True if a negative magnitude is impossible.
    needs
        Quantities that it is computed from, or that every vehicle with this effect has.
    shapes
        Values to try of the parameter that it is non-linear in. A `Quantity` is one of several sources of its input.
    finer_shapes
        Shapes of a finer grid around one of ``shapes``, given the magnitude fitted with it.
    exact_at
        Magnitude at which the power of a shape is exact; None: its power is exact at any.
    shape_key
        Key of a shape; shapes with equal keys count as one in the search.
    describe
        Description of a shape in words.
    timing
        Kind of times at which it acts.
    at_rest
        Power [W] per unit of magnitude during a standstill, for one of the ``shapes``.
    dwell_times
        Usual durations [s] for which a switching effect stays on, or off.
    is_noisy
        True if its power is computed from acceleration or power, and so has their noise.
    is_gravity
        True if its magnitude is the mass: in the model it joins m instead of adding a parameter.
    applied_with
        Quantities with which it is applied to the plain columns; a diagnosis then does not search for it.
    is_absorbed
        True if A, C and m fit it completely, so that no drive gives evidence of it, whatever its size.
    equivalent
        Effects with the same power to first order on any drive.
    alike_unseen
        Effects with nearly the same power that cannot be tested where no signal shows them.
    magnitude_from_coefficient
        Magnitude from its coefficient, where the column uses the acceleration that the force would cause without the
        effect; None: they are equal.
    inertia
        Inertia [kg] (n,) per unit of magnitude, of an effect that takes force in proportion to the acceleration.
    shown_by
        Signal or manoeuvre that would show that it acts.
    """

    name: str
    equation: str
    source: str
    symbol: str
    unit: str
    power: Callable[[View, Shape], Floats]
    usual_magnitude: UsualMagnitude
    max_size: float | None = None
    max_positive_size: float = inf
    positive: bool = True
    needs: tuple[Quantity, ...] = ()
    shapes: tuple[Shape, ...] = (None,)
    finer_shapes: Callable[[Shape, float], tuple[Shape, ...]] | None = None
    exact_at: Callable[[Shape], float] | None = None
    shape_key: Callable[[Shape], object] = lambda shape: shape
    describe: Callable[[Shape], str] | None = None
    timing: Timing = Timing.ALWAYS
    at_rest: Callable[[AtRest, Shape], float] | None = None
    dwell_times: tuple[float, ...] = (200.0,)
    is_noisy: bool = False
    is_gravity: bool = False
    applied_with: tuple[Quantity, ...] = ()
    is_absorbed: bool = False
    equivalent: tuple[str, ...] = ()
    alike_unseen: tuple[str, ...] = ()
    magnitude_from_coefficient: Callable[[float], float] | None = None
    inertia: Callable[[View], Floats] | None = None
    shown_by: str = ""

    def usable_shapes(self, known: Set[Quantity]) -> tuple[Shape, ...]:
        """Shapes that can be computed from the quantities ``known``; none if the effect cannot be tested."""
        if not known >= set(self.needs):
            return ()
        return tuple(shape for shape in self.shapes if not isinstance(shape, Quantity) or shape in known)

    def streaming_shapes(self, known: Set[Quantity]) -> tuple[Shape, ...]:
        """Shapes usable in the streaming model: a signal must show when the effect acts."""
        usable = self.usable_shapes(known)
        return usable if self.timing is Timing.ALWAYS else tuple(s for s in usable if isinstance(s, Quantity))

    def is_applied(self, known: Set[Quantity]) -> bool:
        """True if the quantities ``known`` let the model apply it to the plain columns."""
        return bool(self.applied_with) and known >= set(self.applied_with)

    def limit(self, road_load: Floats) -> float:
        """Largest plausible magnitude for a vehicle with ``road_load`` = [A, C, m]."""
        return USUAL_TO_LARGEST * self.usual_magnitude(road_load) if self.max_size is None else self.max_size

    def wanted(self, known: Set[Quantity]) -> str:
        """Roles that it lacks beside the quantities ``known``: "battery_current, and brake_switch or brake_pedal".

        Signals that show when it acts are wanted where it has no other shape, or where nothing else is missing.
        """
        shapes = [shape for shape in self.shapes if isinstance(shape, Quantity)]
        groups = [[quantity] for quantity in self.needs if quantity not in known]
        if shapes and not known & set(shapes) and (not groups or len(shapes) == len(self.shapes)):
            groups.append(shapes)
        roles = [[role.value for quantity in group for role in SOURCES.get(quantity, ())] for group in groups]
        return ", and ".join(" or ".join(group) for group in roles if group)

    @property
    def is_streaming(self) -> bool:
        """True if it can be in the streaming model: no search for its times, and not absorbed by A, C and m."""
        signalled = any(isinstance(shape, Quantity) for shape in self.shapes)
        return not self.is_absorbed and (self.timing is Timing.ALWAYS or signalled)


def obstacle(effects: Sequence[Effect], known: Set[Quantity]) -> str:
    """Reason why an effect cannot be in the streaming model with the quantities ``known``; empty if all can."""
    effect = _not_shown(effects, known)
    return (
        "" if effect is None else f"the effect {effect.name} needs {effect.wanted(known)}, which the bus does not carry"
    )


def way_past_obstacle(effects: Sequence[Effect], known: Set[Quantity]) -> str:
    """Remedy for an `obstacle`; empty where there is none."""
    effect = _not_shown(effects, known)
    if effect is None:
        return ""
    return f"leave the effect {effect.name} out, or bind {effect.wanted(known)} and give a log that has it"


def _not_shown(effects: Sequence[Effect], known: Set[Quantity]) -> Effect | None:
    return next((effect for effect in effects if not effect.streaming_shapes(known)), None)

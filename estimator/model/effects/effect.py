"""An effect that the road load lacks: the power it adds, as a function of measured quantities.

One object serves the diagnosis (is it there?), the streaming estimator (add it to the model) and the documentation.
"""

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass
from enum import StrEnum
from math import inf
from typing import Any

from estimator.signals import Floats, Quantity, Role

TYPICAL_MASS = 27e3  # kg, a loaded tractor and semi-trailer
USUAL_TO_LARGEST = 4.0  # largest magnitude over the usual one, where no other is known

Shape = Any  # what an effect is non-linear in: a time constant [s], a direction [rad], a source, None
Usual = Callable[[Floats], float]  # usual magnitude for a vehicle with road load [A, C, m]

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
    """The quantities that effects are computed from; all arrays (n,).

    ``t`` [s], ``v`` [m/s], ``a`` [m/s^2] as on level ground, ``P`` [W], ``density`` relative to its mean [1];
    ``road_load`` = [A, C, m] as far as it is known, for effects that scale with it.
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
    """Power [W] taken while the vehicle stood, and its sd [W].

    ``engine_speed`` [rad/s] then, 0 of a motor that stands too; ``elapsed`` [s] since the drive began.
    """

    power: float
    sd: float
    engine_speed: float
    elapsed: float = 0.0


class Timing(StrEnum):
    """When an effect acts, where no signal shows it."""

    ALWAYS = "always"
    WINDOW = "window"  # once, from some time to another
    SWITCHING = "switching"  # on and off, again and again
    STEP = "step"  # from some standstill onwards


def by_mass(value: float) -> Usual:
    """A magnitude that is proportional to the mass; ``value`` is that of a heavy truck, of TYPICAL_MASS."""
    return lambda road_load: value * float(road_load[2]) / TYPICAL_MASS


def always(value: float) -> Usual:
    """A magnitude that is relative already: the same for all vehicles."""
    return lambda road_load: value


@dataclass(frozen=True, kw_only=True)
class Effect:
    """An effect that the plain road load leaves out.

    Parameters
    ----------
    name
        Its name in the configuration.
    equation, source
        What it adds to P, and where that is from.
    symbol, unit
        Of its magnitude.
    power
        Power [W] (n,) per unit of magnitude, given a `View` and one of the ``shapes``.
    usual
        Magnitude that is usual for a vehicle with ``road_load`` = [A, C, m]: scale of its prior.
    largest
        Magnitude beyond which it must be something else, as its coefficient; None: four times the usual one.
    highest
        The same of positive ones, where it is less.
    positive
        Whether a negative magnitude makes no sense.
    needs
        Quantities without which it cannot be computed, or cannot be.
    shapes
        What it is non-linear in: values to try. A `Quantity` stands for itself, as one of several sources.
    finer
        Shapes between one of ``shapes`` and its neighbours, given the magnitude that was found with it.
    describe
        A shape in words.
    timing
        When it acts.
    at_rest
        Power [W] per unit of magnitude that it takes while the vehicle stands, of one of the ``shapes``.
    dwells
        How long [s] it usually stays on, or off, where it switches.
    is_noisy
        Its power is computed from acceleration or power, so that their noise is in it.
    is_gravity
        Its magnitude is the mass: in the model it joins m instead of adding a parameter.
    applied_with
        Quantities with which it is applied to the plain columns, so that a diagnosis does not look for it.
    absorbed
        A, C and m fit it completely, so no drive gives evidence of it, whatever its size.
    equivalent
        Effects with the same power to first order on any drive.
    sized
        Magnitude from its coefficient, where the column is computed with the acceleration that the force gives the
        vehicle without the effect; None: they are the same.
    breaks
        Signal or manoeuvre that would show it.
    """

    name: str
    equation: str
    source: str
    symbol: str
    unit: str
    power: Callable[[View, Shape], Floats]
    usual: Usual
    largest: float | None = None
    highest: float = inf
    positive: bool = True
    needs: tuple[Quantity, ...] = ()
    shapes: tuple[Shape, ...] = (None,)
    finer: Callable[[Shape, float], tuple[Shape, ...]] | None = None
    alike: Callable[[Shape], object] = lambda shape: shape
    describe: Callable[[Shape], str] | None = None
    timing: Timing = Timing.ALWAYS
    at_rest: Callable[[AtRest, Shape], float] | None = None
    dwells: tuple[float, ...] = (200.0,)
    is_noisy: bool = False
    is_gravity: bool = False
    applied_with: tuple[Quantity, ...] = ()
    absorbed: bool = False
    equivalent: tuple[str, ...] = ()
    sized: Callable[[float], float] | None = None
    breaks: str = ""

    def usable_shapes(self, known: Set[Quantity]) -> tuple[Shape, ...]:
        """The shapes that can be computed from what is ``known``; none if it cannot be tested."""
        if not known >= set(self.needs):
            return ()
        return tuple(shape for shape in self.shapes if not isinstance(shape, Quantity) or shape in known)

    def streaming_shapes(self, known: Set[Quantity]) -> tuple[Shape, ...]:
        """The shapes with which it can be in the streaming model: a signal must show when it acts."""
        usable = self.usable_shapes(known)
        return usable if self.timing is Timing.ALWAYS else tuple(s for s in usable if isinstance(s, Quantity))

    def is_applied(self, known: Set[Quantity]) -> bool:
        """Whether the model has it already, computed from what is ``known``."""
        return bool(self.applied_with) and known >= set(self.applied_with)

    def limit(self, road_load: Floats) -> float:
        """Magnitude beyond which it must be something else."""
        return USUAL_TO_LARGEST * self.usual(road_load) if self.largest is None else self.largest

    @property
    def wanted(self) -> tuple[Role, ...]:
        """Roles of which at least one is needed, for a message."""
        quantities = [*self.needs, *(shape for shape in self.shapes if isinstance(shape, Quantity))]
        return tuple(role for quantity in quantities for role in SOURCES.get(quantity, ()))

    @property
    def is_streaming(self) -> bool:
        """Whether it can be in the streaming model: its times need no search, and A, C and m do not absorb it."""
        signalled = any(isinstance(shape, Quantity) for shape in self.shapes)
        return not self.absorbed and (self.timing is Timing.ALWAYS or signalled)


def obstacle(effects: Sequence[Effect], known: Set[Quantity]) -> str:
    """Why not all ``effects`` can be in the streaming model with what is ``known``; empty where they can."""
    for effect in effects:
        if not effect.streaming_shapes(known):
            wanted = " or ".join(role.value for role in effect.wanted)
            return f"the effect {effect.name} needs {wanted}, which the bus does not carry"
    return ""

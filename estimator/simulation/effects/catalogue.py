"""All effects by name: unit, usual magnitude, plausible range for a class-8 truck, and what they are.

They start in the order of the table: an effect sees the road as those before it have left it.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from math import isfinite

import numpy as np

from estimator.errors import InputError
from estimator.simulation.effects import air, powertrain, readings, roads, rolling
from estimator.simulation.effects.effect import Effect
from estimator.simulation.moment import Action, Scene
from estimator.simulation.route import Route
from estimator.simulation.truck import Truck

BEYOND = 2.0  # times the highest plausible magnitude, where the simulated truck might no longer drive

Start = Callable[[Scene, Effect], Action]


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of effect.

    ``low`` to ``high``: plausible magnitudes in ``unit``; ``known_as``: the name that a right diagnosis gives it,
    None for what is in no catalogue and should be called unknown; ``signed``: it may go the other way too.
    """

    start: Start
    unit: str
    usual: float
    low: float
    high: float
    known_as: str | None
    signed: bool = False

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.start.__name__

    @property
    def summary(self) -> str:
        """What it is, in one line."""
        return (self.start.__doc__ or "").strip().splitlines()[0]

    def allows(self, magnitude: float) -> bool:
        """Whether a truck can drive with that."""
        if not isfinite(magnitude) or magnitude > BEYOND * self.high:
            return False
        return magnitude >= -self.high if self.signed else magnitude > 0.0


KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind(roads.grade, "1", 0.010, 0.005, 0.015, "grade"),
        Kind(roads.mass_step, "1", 0.30, 0.12, 0.60, "mass_step", signed=True),
        Kind(air.headwind, "m/s", 5.0, 2.0, 8.0, "headwind"),
        Kind(air.air_density, "K", 12.0, 5.0, 25.0, "air_density", signed=True),
        Kind(air.drafting, "1", 0.25, 0.20, 0.30, "drafting"),
        Kind(rolling.warm_up, "1", 0.25, 0.10, 0.40, "warm_up"),
        Kind(rolling.viscous_drag, "1", 0.40, 0.20, 0.80, "viscous_drag"),
        Kind(rolling.resistance_segment, "1", 0.25, 0.12, 0.40, "resistance_segment"),
        Kind(rolling.cornering, "N/(m/s^2)^2", 600.0, 300.0, 900.0, "cornering"),
        Kind(rolling.load_loss, "1", 0.02, 0.01, 0.03, "load_loss"),
        Kind(rolling.brake_use, "N", 2500.0, 700.0, 12_000.0, "brake_use"),
        Kind(rolling.brake_use_shown, "N", 2500.0, 700.0, 12_000.0, "brake_use"),
        Kind(rolling.retarder_use, "N", 8000.0, 3000.0, 15_000.0, "brake_use"),
        Kind(powertrain.auxiliary_load, "W", 8e3, 3e3, 14e3, "auxiliary_load"),
        Kind(powertrain.auxiliary_cycling, "W", 30e3, 14e3, 60e3, "auxiliary_cycling"),
        Kind(powertrain.air_compressor, "W", 5e3, 3e3, 8e3, "auxiliary_cycling"),
        Kind(powertrain.rotating_inertia, "kg.m^2", 4.0, 2.0, 6.0, "rotating_inertia"),
        Kind(readings.torque_gain, "1", 0.05, 0.03, 0.08, "torque_gain", signed=True),
        Kind(readings.torque_bias, "N.m", 50.0, 20.0, 110.0, "torque_bias", signed=True),
        Kind(readings.sensor_drift, "1", 0.08, 0.04, 0.12, "sensor_drift", signed=True),
        Kind(readings.time_lag, "s", 0.3, 0.05, 0.6, "time_lag"),
        Kind(readings.speed_filter, "s", 0.3, 0.05, 0.6, "speed_filter"),
        Kind(readings.speed_scale, "1", 0.02, 0.01, 0.03, "speed_scale", signed=True),
        Kind(readings.quantisation, "1", 0.01, 0.00125, 0.01, "quantisation"),
        Kind(rolling.snow_plough, "N", 3000.0, 1500.0, 6000.0, None),
        Kind(rolling.gear_loss, "N.m", 120.0, 60.0, 250.0, None),
        Kind(rolling.oil_drag, "1", 0.40, 0.20, 0.60, None),
        Kind(rolling.liquid_surge, "1", 0.30, 0.15, 0.40, None),
        Kind(roads.road_surface, "1", 0.20, 0.10, 0.30, None),
        Kind(air.wind_gusts, "m/s", 2.0, 1.0, 3.0, None),
        Kind(readings.torque_ripple, "N.m", 80.0, 40.0, 150.0, None),
        Kind(readings.gain_walk, "1", 0.05, 0.03, 0.08, None),
        Kind(readings.torque_saturation, "1", 0.06, 0.03, 0.10, None, signed=True),
    )
}


def kind_of(name: str) -> Kind:
    """Look a kind up.

    Raises
    ------
    InputError
        There is no effect of that name; the message lists the known ones.
    """
    try:
        return KINDS[name]
    except KeyError:
        raise InputError(f"there is no effect {name!r}; known are {', '.join(KINDS)}") from None


def effects_from(magnitudes: Mapping[str, float | None]) -> list[Effect]:
    """Effects by name and magnitude, None for the usual one.

    Raises
    ------
    InputError
        Unknown name, or a magnitude that no truck can drive with.
    """
    return [Effect(name, kind_of(name).usual if size is None else size) for name, size in magnitudes.items()]


def parse_effect(text: str) -> Effect:
    """Read ``NAME[=MAGNITUDE][@START[-END]]``, times in [s].

    Raises
    ------
    InputError
        It is not written like that, or there is no such effect.
    """
    what, _, when = text.partition("@")
    name, _, size = what.partition("=")
    kind = kind_of(name)
    try:
        start, _, end = when.partition("-")
        effect = Effect(
            name,
            float(size) if size else kind.usual,
            float(start) if start else None,
            float(end) if end else None,
        )
    except ValueError:
        raise InputError(f"effect {text!r}: write NAME, NAME=NUMBER or NAME=NUMBER@SECONDS-SECONDS") from None
    if effect.start is not None and not 0.0 <= effect.start < (np.inf if effect.end is None else effect.end):
        raise InputError(f"effect {text!r}: does not end after it starts")
    return effect


def start_all(
    effects: Iterable[Effect], truck: Truck, route: Route, duration: float, rng: np.random.Generator
) -> tuple[dict[str, Action], Route]:
    """Set effects to work, and give the road as they leave it.

    Each draws from a source of its own, so that one more effect does not change the others. On a road that is not
    level the air gets thinner uphill whether that was asked for or not.

    Raises
    ------
    InputError
        Unknown name, an effect twice, or a magnitude that no truck can drive with.
    """
    asked: dict[str, Effect] = {}
    for effect in effects:
        kind = kind_of(effect.name)
        if effect.name in asked:
            raise InputError(f"effect {effect.name}: asked for twice; give it one magnitude")
        if not kind.allows(effect.magnitude):
            usual = f"{kind.low:g} to {kind.high:g} {kind.unit}"
            raise InputError(f"effect {effect.name}: cannot be {effect.magnitude:g}; plausible is {usual}")
        asked[effect.name] = effect
    actions: dict[str, Action] = {}
    for (name, kind), own in zip(KINDS.items(), rng.spawn(len(KINDS)), strict=True):
        if name in asked:
            actions[name] = kind.start(Scene(truck, route, duration, own), asked[name])
            route = actions[name].route or route
    if route.grade.any() and "air_density" not in actions:
        actions["air_density"] = air.air_density(Scene(truck, route, duration, rng), Effect("air_density", 0.0))
    return actions, route

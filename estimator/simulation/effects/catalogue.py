"""All effects by name: unit, usual magnitude, plausible range for a class-8 truck, and description.

Effects start in the order of the table: an effect acts on the road as changed by the previous ones.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from math import isfinite

import numpy as np

from estimator.errors import InputError
from estimator.near_names import did_you_mean
from estimator.simulation.effects import air, powertrain, readings, roads, rolling
from estimator.simulation.effects.effect import Effect
from estimator.simulation.moment import Action, Scene
from estimator.simulation.route import Route
from estimator.simulation.truck import Truck

MAX_SIZE_RATIO = 2.0  # times the highest plausible magnitude: with a larger one the simulated truck might not drive

Start = Callable[[Scene, Effect], Action]


@dataclass(frozen=True, slots=True, kw_only=True)
class Kind:
    """Kind of effect.

    ``low`` to ``high`` are plausible magnitudes in ``unit``. ``known_as`` is its name in a correct diagnosis; None if
    it is in no catalogue, and should be called unknown. ``signed``: the magnitude may be negative. ``begins`` and
    ``ends``: its start or end may be given.
    """

    start: Start
    unit: str
    usual: float
    low: float
    high: float
    known_as: str | None
    signed: bool = False
    begins: bool = False
    ends: bool = False

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.start.__name__

    @property
    def summary(self) -> str:
        """Description in one line, from the docstring of its function."""
        return (self.start.__doc__ or "").strip().splitlines()[0]

    def allows(self, magnitude: float) -> bool:
        """True if a truck can drive with this magnitude."""
        if not isfinite(magnitude) or magnitude > MAX_SIZE_RATIO * self.high:
            return False
        return magnitude >= -self.high if self.signed else magnitude > 0.0


KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind(start=roads.grade, unit="1", usual=0.010, low=0.005, high=0.015, known_as="grade"),
        Kind(
            start=roads.mass_step,
            unit="1",
            usual=0.30,
            low=0.12,
            high=0.60,
            known_as="mass_step",
            begins=True,
            signed=True,
        ),
        Kind(start=air.headwind, unit="m/s", usual=5.0, low=2.0, high=8.0, known_as="headwind"),
        Kind(start=air.air_density, unit="K", usual=12.0, low=5.0, high=25.0, known_as="air_density", signed=True),
        Kind(
            start=air.drafting, unit="1", usual=0.25, low=0.20, high=0.30, known_as="drafting", begins=True, ends=True
        ),
        Kind(start=rolling.warm_up, unit="1", usual=0.25, low=0.10, high=0.40, known_as="warm_up"),
        Kind(start=rolling.viscous_drag, unit="1", usual=0.40, low=0.20, high=0.80, known_as="viscous_drag"),
        Kind(
            start=rolling.resistance_segment,
            unit="1",
            usual=0.25,
            low=0.12,
            high=0.40,
            known_as="resistance_segment",
            begins=True,
            ends=True,
        ),
        Kind(start=rolling.cornering, unit="N/(m/s^2)^2", usual=600.0, low=300.0, high=900.0, known_as="cornering"),
        Kind(start=rolling.load_loss, unit="1", usual=0.02, low=0.01, high=0.03, known_as="load_loss"),
        Kind(
            start=rolling.brake_use,
            unit="N",
            usual=2500.0,
            low=700.0,
            high=12_000.0,
            known_as="brake_use",
            begins=True,
            ends=True,
        ),
        Kind(
            start=rolling.brake_use_shown,
            unit="N",
            usual=2500.0,
            low=700.0,
            high=12_000.0,
            known_as="brake_use",
            begins=True,
            ends=True,
        ),
        Kind(
            start=rolling.retarder_use,
            unit="N",
            usual=8000.0,
            low=3000.0,
            high=15_000.0,
            known_as="brake_use",
        ),
        Kind(start=powertrain.auxiliary_load, unit="W", usual=8e3, low=3e3, high=14e3, known_as="auxiliary_load"),
        Kind(
            start=powertrain.auxiliary_cycling,
            unit="W",
            usual=30e3,
            low=14e3,
            high=60e3,
            known_as="auxiliary_cycling",
            begins=True,
            ends=True,
        ),
        Kind(
            start=powertrain.air_compressor,
            unit="W",
            usual=5e3,
            low=3e3,
            high=8e3,
            known_as="auxiliary_cycling",
            begins=True,
            ends=True,
        ),
        Kind(
            start=powertrain.rotating_inertia, unit="kg.m^2", usual=4.0, low=2.0, high=6.0, known_as="rotating_inertia"
        ),
        Kind(
            start=readings.torque_gain, unit="1", usual=0.05, low=0.03, high=0.08, known_as="torque_gain", signed=True
        ),
        Kind(
            start=readings.torque_bias,
            unit="N.m",
            usual=50.0,
            low=20.0,
            high=110.0,
            known_as="torque_bias",
            signed=True,
        ),
        Kind(
            start=readings.sensor_drift, unit="1", usual=0.08, low=0.04, high=0.12, known_as="sensor_drift", signed=True
        ),
        Kind(start=readings.time_lag, unit="s", usual=0.3, low=0.05, high=0.6, known_as="time_lag"),
        Kind(start=readings.speed_filter, unit="s", usual=0.3, low=0.05, high=0.6, known_as="speed_filter"),
        Kind(
            start=readings.speed_scale, unit="1", usual=0.02, low=0.01, high=0.03, known_as="speed_scale", signed=True
        ),
        Kind(start=readings.quantisation, unit="1", usual=0.01, low=0.00125, high=0.01, known_as="quantisation"),
        Kind(start=rolling.snow_plough, unit="N", usual=3000.0, low=1500.0, high=6000.0, known_as=None),
        Kind(start=rolling.gear_loss, unit="N.m", usual=120.0, low=60.0, high=250.0, known_as=None),
        Kind(start=rolling.oil_drag, unit="1", usual=0.40, low=0.20, high=0.60, known_as="oil_warm_up"),
        Kind(start=rolling.liquid_surge, unit="1", usual=0.30, low=0.15, high=0.40, known_as=None),
        Kind(start=roads.road_surface, unit="1", usual=0.20, low=0.10, high=0.30, known_as=None),
        Kind(start=air.wind_gusts, unit="m/s", usual=2.0, low=1.0, high=3.0, known_as=None),
        Kind(start=readings.torque_ripple, unit="N.m", usual=80.0, low=40.0, high=150.0, known_as=None),
        Kind(start=readings.gain_walk, unit="1", usual=0.05, low=0.03, high=0.08, known_as=None),
        Kind(start=readings.torque_saturation, unit="1", usual=0.06, low=0.03, high=0.10, known_as=None, signed=True),
        Kind(start=rolling.slow_puncture, unit="1", usual=0.25, low=0.15, high=0.40, known_as=None, begins=True),
    )
}


def kind_of(name: str) -> Kind:
    """Look up a kind by name.

    Raises
    ------
    InputError
        There is no effect with this name; the message lists the known ones.
    """
    try:
        return KINDS[name]
    except KeyError:
        guess = did_you_mean(name, KINDS) or f"; known are {', '.join(KINDS)}"
        raise InputError(f"there is no effect {name!r}{guess}") from None


def effects_from(magnitudes: Mapping[str, float | None]) -> list[Effect]:
    """Make effects from names and magnitudes, None for the usual magnitude.

    Raises
    ------
    InputError
        A name is unknown, or no truck can drive with the magnitude.
    """
    return [
        Effect(name=name, magnitude=kind_of(name).usual if size is None else size) for name, size in magnitudes.items()
    ]


def parse_effect(text: str) -> Effect:
    """Read ``NAME[=MAGNITUDE][@START[-END]]``, times in [s].

    Raises
    ------
    InputError
        The text has another form, or there is no such effect.
    """
    what, _, when = text.partition("@")
    name, _, size = what.partition("=")
    kind = kind_of(name)
    try:
        start, dash, end = when.partition("-")
        effect = Effect(
            name=name,
            magnitude=float(size) if "=" in what else kind.usual,
            start=float(start) if "@" in text else None,
            end=float(end) if dash else None,
        )
    except ValueError:
        raise InputError(f"effect {text!r}: write NAME, NAME=NUMBER or NAME=NUMBER@SECONDS-SECONDS") from None
    if effect.start is not None and not kind.begins:
        timed = ", ".join(name for name, kind in KINDS.items() if kind.begins)
        raise InputError(f"effect {text!r}: {name} acts all the time; times can be given to {timed}")
    if effect.end is not None and not kind.ends:
        raise InputError(f"effect {text!r}: {name} lasts to the end; give its beginning alone")
    if effect.start is not None and not 0.0 <= effect.start < (np.inf if effect.end is None else effect.end):
        raise InputError(f"effect {text!r}: does not end after it starts")
    return effect


def start_all(
    effects: Iterable[Effect], truck: Truck, route: Route, duration: float, rng: np.random.Generator
) -> tuple[dict[str, Action], Route]:
    """Start the effects; returns them by name, and the road as changed by them.

    Each effect has its own random generator, so that a further effect does not change the others. On a road that is not
    level, the density of the air falls with altitude in any case.

    Raises
    ------
    InputError
        A name is unknown, an effect is given twice, or no truck can drive with a magnitude.
    """
    asked: dict[str, Effect] = {}
    for effect in effects:
        kind = kind_of(effect.name)
        if effect.name in asked:
            raise InputError(f"effect {effect.name}: asked for twice; give it one magnitude")
        if not kind.allows(effect.magnitude):
            usual = f"{kind.low:g} to {kind.high:g} {kind.unit}".removesuffix(" 1")
            raise InputError(f"effect {effect.name}: cannot be {effect.magnitude:g}; plausible is {usual}")
        asked[effect.name] = effect
    actions: dict[str, Action] = {}
    for (name, kind), generator in zip(KINDS.items(), rng.spawn(len(KINDS)), strict=True):
        if name in asked:
            actions[name] = kind.start(Scene(truck, route, duration, generator), asked[name])
            route = actions[name].route or route
    if route.grade.any() and "air_density" not in actions:
        actions["air_density"] = air.air_density(
            Scene(truck, route, duration, rng), Effect(name="air_density", magnitude=0.0)
        )
    return actions, route

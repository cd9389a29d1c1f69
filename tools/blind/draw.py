"""Draw drives: kind, effects and their sizes, truck, road, sensors and signals on the bus."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import cycle, islice
from math import exp, log
from typing import TypeVar

import numpy as np

from blind.truth import Kind
from estimator.signals import Role
from estimator.simulation.effects.catalogue import KINDS
from estimator.simulation.itinerary import Shape
from estimator.simulation.route import RoadKind
from estimator.simulation.sensors import Sensors
from estimator.simulation.truck import Truck, draw_truck

MIX: dict[Kind, float] = {"clean": 0.25, "single": 0.45, "pair": 0.15, "outside": 0.15}
ROADS: tuple[RoadKind, ...] = ("mixed", "highway", "urban", "mixed")
SHAPES: tuple[Shape, ...] = ("one-way", "out-and-back", "loop")
SPEED_NOISE = (0.0, 0.003, 0.008, 0.015, 0.030)  # m/s
TORQUE_RESOLUTION = (0.00125, 0.01)  # share of the reference torque
TORQUE_NOISE = 5.0, 15.0  # N.m
TORQUE_CORRELATION = 0.90, 0.98  # from one tenth of a second to the next
MISALIGNMENT = 0.03, 0.10  # s
LAG = 0.15  # s, shortest that counts as an effect; every drive has a smaller misalignment
MAX_UNLOADING = 0.4  # share of the mass: more would leave less than the empty truck
PRESENT = 0.7  # probability that an optional signal is on the bus

CATALOGUE = tuple(name for name, kind in KINDS.items() if kind.known_as is not None and name != "quantisation")
OUTSIDE = tuple(name for name, kind in KINDS.items() if kind.known_as is None)
PAIRED = (  # effects visible at their usual size; pairs with similar traces are drawn as well
    "grade",
    "headwind",
    "warm_up",
    "auxiliary_cycling",
    "mass_step",
    "resistance_segment",
    "cornering",
    "sensor_drift",
    "drafting",
    "load_loss",
    "torque_bias",
    "brake_use",
    "time_lag",
)
SIGNED = ("torque_bias", "torque_gain", "speed_scale", "sensor_drift", "mass_step", "air_density", "torque_saturation")
NEEDED: dict[str, tuple[Role, ...]] = {  # an effect needs at least one of these signals
    "headwind": (Role.HEADING,),
    "cornering": (Role.LATERAL_ACCELERATION, Role.YAW_RATE),
}
TOGETHER = ((Role.ALTITUDE, Role.GPS_SPEED), (Role.AMBIENT_TEMPERATURE, Role.AIR_PRESSURE))  # one message each
ALONE = (
    Role.GRADE,
    Role.HEADING,
    Role.COOLANT_TEMPERATURE,
    Role.FAN_SPEED,
    Role.YAW_RATE,
    Role.LATERAL_ACCELERATION,
    Role.GEAR,
)
ABSENT = (Role.LONGITUDINAL_ACCELERATION, Role.LATITUDE, Role.LONGITUDE)  # of every drive

Card = TypeVar("Card")


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """One drive to be made; ``given``: the road is hilly, and ``grade`` is in the configuration."""

    drive: str
    seed: int
    kind: Kind
    minutes: float
    road: RoadKind
    shape: Shape
    truck: Truck
    effects: dict[str, float]
    sensors: Sensors
    given: bool


def draw(drives: int, seed: int, minutes: float, hilly: float = 0.0, only: Kind | None = None) -> list[Plan]:
    """Plans of ``drives`` drives of about ``minutes``; a share ``hilly`` has hills that are in the configuration.

    All are of the kind ``only``; None: of all kinds, as MIX says.

    Kinds, effects, noise levels and roads are taken in turn from shuffled lists, so that all are equally frequent.
    """
    rng = np.random.default_rng(seed)
    kinds = _kinds(drives, rng) if only is None else [only] * drives
    noise = _deck([(v, T) for v in SPEED_NOISE for T in TORQUE_RESOLUTION], rng)
    clean_noise = _deck([(v, T) for v in SPEED_NOISE for T in TORQUE_RESOLUTION], rng)
    singles, outsiders = _deck(CATALOGUE, rng), _deck(OUTSIDE, rng)
    roads = _deck([(road, shape) for road in ROADS for shape in SHAPES], rng)
    plans = []
    for i, kind in enumerate(kinds):
        own = np.random.default_rng([seed, i])
        names: tuple[str, ...] = ()
        if kind == "single":
            names = (next(singles),)
        elif kind == "outside":
            names = (next(outsiders),)
        elif kind == "pair":
            names = tuple(own.choice(PAIRED, 2, replace=False).tolist())
        effects = {name: magnitude(name, own) for name in names}
        given = bool(own.random() < hilly) and "grade" not in effects
        road, shape = next(roads)
        truck = draw_truck(own)
        speed_noise, resolution = next(clean_noise if kind == "clean" else noise)
        sensors = draw_sensors(speed_noise, resolution, truck, names, given, own)
        length = float(minutes * own.uniform(0.9, 1.1))
        plans.append(
            Plan(
                drive=f"drive-{i:04d}",
                seed=i,
                kind=kind,
                minutes=length,
                road=road,
                shape=shape,
                truck=truck,
                effects=effects,
                sensors=sensors,
                given=given,
            )
        )
    return plans


def magnitude(name: str, rng: np.random.Generator) -> float:
    """Log-uniform over the plausible range, with random sign if the effect has both."""
    kind = KINDS[name]
    low = LAG if name in ("time_lag", "speed_filter") else kind.low
    size = exp(rng.uniform(log(low), log(kind.high)))
    if name in SIGNED and rng.random() < 0.5:
        return -min(size, MAX_UNLOADING) if name == "mass_step" else -size
    return size


def draw_sensors(
    speed_noise: float,
    resolution: float,
    truck: Truck,
    effects: Sequence[str],
    given: bool,
    rng: np.random.Generator,
) -> Sensors:
    """Sensors with all nuisances; signals that are necessary to identify the drive's effects are present."""
    without = {role for roles in (*TOGETHER, *((role,) for role in ALONE)) if rng.random() > PRESENT for role in roles}
    for effect in effects:
        if effect in NEEDED and without >= set(NEEDED[effect]):
            without.remove(NEEDED[effect][0])
    if given:
        without -= {Role.ALTITUDE, Role.GPS_SPEED, Role.GRADE}
    return Sensors(
        speed_noise=speed_noise,
        torque_noise=rng.uniform(*TORQUE_NOISE) / truck.reference_torque,
        torque_correlation=-0.1 / log(rng.uniform(*TORQUE_CORRELATION)),
        torque_resolution=resolution,
        torque_lag=rng.uniform(*MISALIGNMENT),
        grade_noise=rng.uniform(0.0003, 0.002),
        grade_offset=rng.normal(0.0, 0.001),
        altitude_noise=rng.uniform(0.3, 3.0),
        dropouts=float(rng.choice([0.0, 0.002])),
        without=frozenset({*without, *ABSENT}),
    )


def _kinds(drives: int, rng: np.random.Generator) -> list[Kind]:
    edges = np.round(np.cumsum(list(MIX.values())) * drives).astype(int)
    counts = np.diff(edges, prepend=0)
    kinds = [kind for kind, count in zip(MIX, counts, strict=True) for _ in range(count)]
    return [kinds[i] for i in rng.permutation(drives)]


def _deck(cards: Sequence[Card], rng: np.random.Generator) -> Iterator[Card]:
    """Items in random order without end; each round holds every item once."""
    own = rng.spawn(1)[0]
    for _ in cycle([None]):
        yield from islice((cards[i] for i in own.permutation(len(cards))), len(cards))

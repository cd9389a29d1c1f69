"""Recording of a drive: signals on the bus, and true quantities."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from estimator.signals import Signals
from estimator.simulation.drive import drive
from estimator.simulation.effects.catalogue import effects_from
from estimator.simulation.effects.effect import Effect
from estimator.simulation.itinerary import Shape, plan_route
from estimator.simulation.route import RoadKind, Route
from estimator.simulation.sensors import Sensors, measure
from estimator.simulation.truck import Truck
from estimator.simulation.truth import Truth


@dataclass(frozen=True, slots=True)
class Recording:
    """Measured ``signals`` by role, with times from the start of the drive [s], and the ``truth``."""

    signals: Signals
    truth: Truth


def record(
    truck: Truck,
    route: Route,
    duration: float,
    rng: np.random.Generator,
    *,
    sensors: Sensors | None = None,
    effects: Iterable[Effect] = (),
) -> Recording:
    """Drive, and measure the drive, which does not depend on the sensors.

    Parameters
    ----------
    truck, route
        Truck, and its road.
    duration
        Length of the drive [s].
    rng
        Source of randomness.
    sensors
        Errors of the truck's sensors; by default those of an ordinary truck.
    effects
        Effects beyond the plain road load; by default none.

    Raises
    ------
    InputError
        An effect is unknown, or its magnitude is impossible.
    """
    drive_rng, sensor_rng = rng.spawn(2)
    truth = drive(truck, route, duration, drive_rng, effects)
    return Recording(measure(truth, sensors or Sensors(), sensor_rng), truth)


def simulate(
    truck: Truck,
    kind: RoadKind,
    duration: float,
    rng: np.random.Generator,
    *,
    shape: Shape = "one-way",
    effects: Mapping[str, float | None] | Iterable[Effect] = (),
    sensors: Sensors | None = None,
) -> Recording:
    """Plan a road of a kind and shape, and `record` a drive; ``effects`` by name and magnitude, or as `Effect`."""
    route = plan_route(kind, duration, rng, shape)
    asked = effects_from(effects) if isinstance(effects, Mapping) else effects
    return record(truck, route, duration, rng, sensors=sensors, effects=asked)

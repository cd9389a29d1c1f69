"""A recorded drive: what the bus would tell, beside what really happened."""

from dataclasses import dataclass

import numpy as np

from estimator.signals import Signals
from estimator.simulation.drive import Disturbance, Truth, drive
from estimator.simulation.route import Route
from estimator.simulation.sensors import Sensors, measure
from estimator.simulation.truck import Truck


@dataclass(frozen=True, slots=True)
class Recording:
    """``signals`` by role, as measured, times from the start of the drive [s]; and the ``truth``."""

    signals: Signals
    truth: Truth


def record(
    truck: Truck,
    route: Route,
    duration: float,
    rng: np.random.Generator,
    *,
    sensors: Sensors | None = None,
    disturbance: Disturbance | None = None,
) -> Recording:
    """Drive and measure; the drive does not depend on the sensors.

    Parameters
    ----------
    truck, route
        What is driven, and where.
    duration
        Length of the drive [s].
    rng
        Source of randomness.
    sensors
        How well the truck measures; an ordinary truck by default.
    disturbance
        Physics beyond the plain truck; none by default.
    """
    drive_rng, sensor_rng = rng.spawn(2)
    truth = drive(truck, route, duration, drive_rng, disturbance)
    return Recording(measure(truth, sensors or Sensors(), sensor_rng), truth)

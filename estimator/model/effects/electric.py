"""Effects on the power of a traction battery: conversion losses and other consumers.

A loss in proportion to the power in both directions equals a gain error. What differs from it is the other share lost
in regeneration, which shows only where the bus reports the service brake as off.
"""

import numpy as np

from estimator.model.effects.cold import cold_by_time, finer_times, told_time
from estimator.model.effects.effect import Effect, always, by_mass
from estimator.signals import Quantity

HEATER_TIMES = tuple(60.0 * minutes for minutes in (2, 3, 5, 8, 12, 20))  # s


REGENERATION_LOSS = Effect(
    name="regeneration_loss",
    equation="r max(-P, 0)",
    source="motor, inverter and battery lose more in braking than in driving",
    symbol="share lost",
    unit="1",
    power=lambda view, shape: np.maximum(-view.P, 0.0),
    usual_magnitude=always(0.25),
    max_size=2.0,
    needs=(Quantity.BATTERY_CURRENT, Quantity.BRAKE),
    is_noisy=True,
    shown_by="the motor's torque on the bus",
)

CABIN_HEATER = Effect(
    name="cabin_heater",
    equation="Ph exp(-t / tau)",
    source="cabin and battery are heated from cold (Argonne D3)",
    symbol="Ph",
    unit="W",
    power=cold_by_time,
    usual_magnitude=by_mass(40e3),
    max_size=40e3,
    needs=(Quantity.BATTERY_CURRENT, Quantity.ELAPSED),
    shapes=HEATER_TIMES,
    finer_shapes=finer_times,
    describe=told_time,
    at_rest=lambda rest, time: float(np.exp(-rest.elapsed / time)),
    shown_by="the heater's power on the bus",
)

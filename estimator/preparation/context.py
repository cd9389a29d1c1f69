"""Quantities of rows besides speed and power: those that effects are computed from, and the density of the air."""

import numpy as np

from estimator.samples import Rows
from estimator.signals import Floats, Quantity, Role

GAS_CONSTANT = 287.05  # J/(kg K), of dry air
ROLE_OF = {  # of the quantities that a role gives as it is
    Quantity.ENGINE_SPEED: Role.ENGINE_SPEED,
    Quantity.GEAR: Role.GEAR,
    Quantity.HEADING: Role.HEADING,
    Quantity.LATERAL_ACCELERATION: Role.LATERAL_ACCELERATION,
    Quantity.FAN_SPEED: Role.FAN_SPEED,
    Quantity.BATTERY_CURRENT: Role.BATTERY_CURRENT,
    Quantity.TEMPERATURE: Role.AMBIENT_TEMPERATURE,
}


def quantities_of(rows: Rows, start: float) -> dict[Quantity, Floats]:
    """Quantities of rows, each (n,); elapsed time is counted from ``start`` [s]."""
    quantities = {Quantity.ELAPSED: rows.t - start, **rows.derived}
    quantities |= {quantity: rows.context[role] for quantity, role in ROLE_OF.items() if role in rows.context}
    for role in (Role.BRAKE_PEDAL, Role.BRAKE_SWITCH):
        if role in rows.context:
            quantities[Quantity.BRAKE] = rows.context[role]
    if Role.YAW_RATE in rows.context and Quantity.LATERAL_ACCELERATION not in quantities:
        quantities[Quantity.LATERAL_ACCELERATION] = rows.context[Role.YAW_RATE] * rows.plausible_speed
    return quantities


def air_density(rows: Rows) -> Floats:
    """Density of dry air [kg/m^3] (n,) from temperature and pressure; NaN where either is unknown."""
    blank = np.full(len(rows), np.nan)
    temperature = rows.context.get(Role.AMBIENT_TEMPERATURE, blank)
    return rows.context.get(Role.AIR_PRESSURE, blank) / (GAS_CONSTANT * temperature)

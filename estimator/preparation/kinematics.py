"""Samples of the model from rows of the time grid: speed, acceleration, power, their instruments, and the context.

One and the same low-pass acts on both sides of the model, and power is moved back by its lag.
"""

from collections.abc import Set

import numpy as np

from estimator.preparation.lag import MAX_LAG
from estimator.preparation.smoothing import REACH, Kernels, convolve, instrument_kernels, slow_kernel
from estimator.samples import STEP, Rows, Samples
from estimator.signals import Floats, Quantity, Role
from estimator.units import STANDARD_GRAVITY

GAS_CONSTANT = 287.05  # J/(kg K), of dry air


def to_samples(
    rows: Rows, kernels: Kernels, lag: float, inertial: bool, wanted: Set[Quantity] = frozenset(), start: float = 0.0
) -> Samples:
    """Samples for the rows that have REACH on either side, one each; NaN where anything needed is missing.

    ``lag`` [s] is the delay of power behind speed. ``inertial`` adds the slow part of the longitudinal accelerometer's
    difference from dv/dt, which is gravity along the grade: the engine's force is m (dv/dt + g sin) plus resistance.
    The fast part is left out: it is pitch on the suspension and vibration. ``wanted`` context that the bus does not
    carry is NaN; time elapsed counts from ``start`` [s].
    """
    ring = instrument_kernels(STEP)
    step = int(np.floor(lag / STEP))
    share = lag / STEP - step
    later = _shift(rows.power, step)
    power = later if share == 0 else (1 - share) * later + share * _shift(rows.power, step + 1)
    speed = rows.plausible_speed
    a, za = convolve(speed, kernels.slope), convolve(speed, ring.slope)
    if inertial:
        sensed = rows.context.get(Role.LONGITUDINAL_ACCELERATION, np.full(len(rows), np.nan))
        gravity = convolve(sensed - np.gradient(speed, STEP), slow_kernel(STEP))
        a, za = a + gravity, za + gravity
    context = {quantity: values for quantity, values in quantities(rows, start).items() if quantity in wanted}
    blank = np.full(len(rows), np.nan)
    samples = Samples(
        t=rows.t,
        v=convolve(speed, kernels.value),
        a=a,
        P=convolve(power, kernels.value),
        dP=convolve(power, kernels.slope),
        zv=convolve(speed, ring.value),
        za=za,
        zdP=convolve(power, ring.slope),
        density=air_density(rows),
        context={quantity: context.get(quantity, blank) for quantity in sorted(wanted)},
    )
    return samples[margin(STEP) : len(rows) - margin(STEP)]


def quantities(rows: Rows, start: float) -> dict[Quantity, Floats]:
    """Quantities of the rows besides speed and power, each (n,); time elapsed counts from ``start`` [s].

    Climb is gravity along the road, low-passed as wide as the ring of the instruments: faster changes of an altimeter
    or accelerometer are noise and pitch. The rate of an altitude is its convolution with the low-pass' derivative.
    """
    found = measured(rows, start)
    speed = rows.plausible_speed
    slow = slow_kernel(STEP)
    if Role.GRADE in rows.context:
        grade = convolve(rows.context[Role.GRADE], slow)
        found[Quantity.CLIMB_BY_GRADE] = speed * grade / np.hypot(1.0, grade)
    if Role.ALTITUDE in rows.context:
        found[Quantity.CLIMB_BY_ALTITUDE] = convolve(rows.context[Role.ALTITUDE], np.gradient(slow, STEP))
    if Role.LONGITUDINAL_ACCELERATION in rows.context:
        gravity = convolve(rows.context[Role.LONGITUDINAL_ACCELERATION] - np.gradient(speed, STEP), slow)
        found[Quantity.CLIMB_BY_ACCELEROMETER] = speed * gravity / STANDARD_GRAVITY
    return found


def measured(rows: Rows, start: float) -> dict[Quantity, Floats]:
    """Quantities that a row has by itself, each (n,); time elapsed counts from ``start`` [s]."""
    found = {Quantity.ELAPSED: rows.t - start, **rows.derived}
    same = {
        Quantity.ENGINE_SPEED: Role.ENGINE_SPEED,
        Quantity.GEAR: Role.GEAR,
        Quantity.HEADING: Role.HEADING,
        Quantity.LATERAL_ACCELERATION: Role.LATERAL_ACCELERATION,
        Quantity.FAN_SPEED: Role.FAN_SPEED,
        Quantity.BATTERY_CURRENT: Role.BATTERY_CURRENT,
        Quantity.TEMPERATURE: Role.AMBIENT_TEMPERATURE,
    }
    found |= {quantity: rows.context[role] for quantity, role in same.items() if role in rows.context}
    for role in (Role.BRAKE_PEDAL, Role.BRAKE_SWITCH):
        if role in rows.context:
            found[Quantity.BRAKE] = rows.context[role]
    if Role.YAW_RATE in rows.context and Quantity.LATERAL_ACCELERATION not in found:
        found[Quantity.LATERAL_ACCELERATION] = rows.context[Role.YAW_RATE] * rows.plausible_speed
    return found


def air_density(rows: Rows) -> Floats:
    """Density of dry air [kg/m^3] (n,) from temperature and pressure, NaN where either is not known."""
    blank = np.full(len(rows), np.nan)
    temperature = rows.context.get(Role.AMBIENT_TEMPERATURE, blank)
    return rows.context.get(Role.AIR_PRESSURE, blank) / (GAS_CONSTANT * temperature)


def margin(dt: float) -> int:
    """Rows needed on either side of a sample: the ring, and room for the lag."""
    return round((REACH + MAX_LAG) / dt)


def _shift(signal: Floats, steps: int) -> Floats:
    """``signal`` taken ``steps`` later, NaN where that leaves the array."""
    out = np.full(len(signal), np.nan)
    if steps >= 0:
        out[: len(signal) - steps] = signal[steps:]
    else:
        out[-steps:] = signal[:steps]
    return out

"""Tests for contradictory readings of one quantity: between two senders, or within those of one address.

The limits were set between two sets of recordings. The first has 8,065 blocks of 5 s of a BMW i3, 16 of a Kenworth T270
and 540 of a simulated truck. None of them may count as a contradiction. The second is this traffic with a second sender
added. The largest values in the first set are given at each limit.
"""

from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from estimator.signals import Floats, Mask, Role

MAX_LATENESS = 0.3  # s by which two honest senders may differ in time
TOLERANCE = 0.02  # of the quantity's magnitude, by which two honest senders may differ
QUANTA = 2.5  # steps of resolution that are no difference
MIN_READINGS = 20  # readings for a verdict on one sender
MAX_STEP_RATIO = 1.6  # mean step to the next reading over that to the next but one; honest: at most 1.25
MIN_MATERIAL_STEP = 0.03  # of the magnitude, and QUANTA: by which a reading of a mixture is beyond both its neighbours
MAX_MATERIAL_SHARE = 0.22  # share of such readings; honest: at most 0.17
MIN_SLIGHT_STEP, SLIGHT_QUANTA = 0.003, 1.5  # the same, where all of them lie on one side
MIN_SLIGHT_SHARE = 0.04  # share of such readings
MAX_ONE_SIDED_SDS = 4.0  # standard deviations of a fair coin for "all on one side"; honest: at most 2.8
MAX_CHANGES = 10  # of a switch or a gear in one block of 5 s; honest: at most 5
MAGNITUDE = {  # what the quantity usually is on the road, at least: smaller values matter little
    Role.SPEED: 10.0,  # m/s
    Role.WHEEL_SPEEDS: 10.0,  # m/s
    Role.ENGINE_POWER: 20e3,  # W
    Role.ENGINE_TORQUE: 50.0,  # N m
    Role.ENGINE_SPEED: 100.0,  # rad/s
    Role.TORQUE_FRACTION: 0.3,
    Role.FRICTION_FRACTION: 0.1,
    Role.PARASITIC_FRACTION: 0.1,
    Role.BRAKE_PEDAL: 0.3,
    Role.RETARDER_FRACTION: 0.3,
    Role.BATTERY_VOLTAGE: 200.0,  # V
    Role.BATTERY_CURRENT: 50.0,  # A
}


class Contradiction(StrEnum):
    """Kind of contradiction; the value is the reason that is counted and shown."""

    SENDERS_DISAGREE = "senders disagree"
    ALTERNATING = "values alternate"
    FASTER = "faster than its own rate"
    CHANGED = "a constant changed"


def is_disagreement(
    t: Floats, value: Floats, other_t: Floats, other_value: Floats, magnitude: float, step: float
) -> bool | None:
    """Test whether the means of two senders differ by more than delay, resolution and calibration explain.

    Returns None if they do not send at the same time.

    Parameters
    ----------
    t, value
        Readings (n,) of one sender: times [s], ascending, and values [SI].
    other_t, other_value
        Readings (m,) of the other sender.
    magnitude
        Usual magnitude of the quantity [SI].
    step
        Resolution of the values [SI].
    """
    if len(t) < len(other_t):
        t, value, other_t, other_value = other_t, other_value, t, value
    common = (other_t >= t[0]) & (other_t <= t[-1])
    if not common.any():
        return None
    difference = other_value[common] - np.interp(other_t[common], t, value)
    drift = abs(float(value[-1] - value[0])) / max(float(t[-1] - t[0]), MAX_LATENESS)
    size = max(magnitude, float(np.abs(value).mean()))
    return abs(float(difference.mean())) > QUANTA * step + TOLERANCE * size + MAX_LATENESS * drift


def are_alternating(value: Floats, bounds: NDArray[np.intp], magnitude: float, step: float) -> Mask:
    """Test whether consecutive readings of one address look like a mixture of two senders.

    If two senders alternate strictly, a reading is closer to the next but one than to the next. In any other mixture,
    readings lie beyond both their neighbours; they lie on one side if one sender sends much more often. Resolution and
    noise cause neither.

    Parameters
    ----------
    value
        Readings (n,), in blocks between ``bounds`` (k + 1,), none of them empty.
    magnitude
        Usual magnitude of the quantity [SI].
    step
        Resolution of the values [SI].

    Returns
    -------
    Mask
        True for each block (k,) that looks like a mixture.
    """
    count = np.diff(bounds)
    size = np.maximum(magnitude, block_sums(np.abs(value), bounds) / count)
    steps = _steps(value, bounds, 1)
    sizes = np.abs(steps)
    next_step = block_sums(sizes, bounds) / np.maximum(count - 1, 1)
    is_mixture: Mask = next_step > step + TOLERANCE / 2 * size
    if is_mixture.any():
        next_but_one = block_sums(np.abs(_steps(value, bounds, 2)), bounds) / np.maximum(count - 2, 1)
        is_mixture &= next_step > MAX_STEP_RATIO * next_but_one
    is_mixture |= _exceed_neighbours(
        value,
        _reversals(steps, sizes),
        bounds,
        QUANTA * step + MIN_MATERIAL_STEP * size,
        SLIGHT_QUANTA * step + MIN_SLIGHT_STEP * size,
    )
    return is_mixture & (count >= MIN_READINGS)


def _steps(value: Floats, bounds: NDArray[np.intp], ahead: int) -> Floats:
    """Difference (n,) from each reading to the one ``ahead`` readings later; zero where that is in another block."""
    steps = np.zeros(len(value))
    np.subtract(value[ahead:], value[:-ahead], out=steps[:-ahead])
    for back in range(1, ahead + 1):
        steps[bounds[1:] - back] = 0.0
    return steps


def _reversals(steps: Floats, sizes: Floats) -> Floats:
    """Distance (n,) by which readings lie beyond both neighbours, from the steps to the next and their sizes."""
    beyond = np.zeros(len(steps))
    np.minimum(sizes[:-1], sizes[1:], out=beyond[1:])
    beyond[1:] *= steps[:-1] * steps[1:] < 0
    return beyond


def _exceed_neighbours(
    value: Floats, beyond: Floats, bounds: NDArray[np.intp], material: Floats, slight: Floats
) -> Mask:
    """Mask (k,) of blocks in which too many readings lie ``beyond`` both neighbours, by the limits (k,) of each."""
    if beyond.max() <= slight.min():
        return np.zeros(len(slight), dtype=bool)
    count = np.diff(bounds)
    too_many: Mask = block_sums(beyond > np.repeat(material, count), bounds) > MAX_MATERIAL_SHARE * count
    out = beyond > np.repeat(slight, count)
    sides, number = np.zeros(len(value)), block_sums(out, bounds)
    sides[out] = np.sign(value[out] - value[np.flatnonzero(out) - 1])
    one_sided = np.maximum(*(np.abs(block_sums(values, bounds)) for values in (sides, sides * np.sign(value))))
    return too_many | (number > MIN_SLIGHT_SHARE * count) & (one_sided >= MAX_ONE_SIDED_SDS * np.sqrt(number))


def are_flickering(value: Floats, bounds: NDArray[np.intp]) -> Mask:
    """Mask (k,) of blocks in which a switch or gear (n,) changes more often than a driver or gearbox can change it.

    Blocks of 5 s lie between ``bounds`` (k + 1,), none of them empty.
    """
    changed = np.diff(value, append=0.0) != 0
    changed[bounds[1:] - 1] = False  # not from one block to the next
    is_flickering: Mask = block_sums(changed, bounds) > MAX_CHANGES
    return is_flickering


def block_sums(values: Floats | Mask, bounds: NDArray[np.intp]) -> Floats:
    """Sums (k,) of values (n,) in the blocks between ``bounds`` (k + 1,), none of them empty.

    The rounding of each sum depends on its block alone.
    """
    sums: Floats = np.add.reduceat(values.astype(np.float64, copy=False), bounds[:-1])
    return sums

"""Whether readings of one quantity contradict each other: between two senders, or within those of one address.

The limits were set between two sets of recordings: 8,065 blocks of 5 s of a BMW i3, 16 of a Kenworth T270 and 540 of a
simulated truck, none of which may be called a contradiction, and the same traffic with a second sender added. The
largest values of the first are given at each limit.
"""

from enum import StrEnum

import numpy as np

from estimator.signals import Floats, Role

MAX_LATENESS = 0.3  # s by which two honest senders may differ in time
TOLERANCE = 0.02  # of the quantity's magnitude, by which two honest senders may differ
QUANTA = 2.5  # steps of resolution that are no difference
MIN_READINGS = 20  # readings for a verdict on one sender
MAX_STEP_RATIO = 1.6  # mean step to the next reading over that to the next but one; honest: at most 1.25
MIN_MATERIAL_STEP = 0.03  # of the magnitude, and QUANTA: by which a reading of a mixture is beyond both its neighbours
MAX_MATERIAL_SHARE = 0.22  # share of such readings; honest: at most 0.17
MIN_SLIGHT_STEP, SLIGHT_QUANTA = 0.003, 1.5  # the same, where all of them lie on one side
MIN_SLIGHT_SHARE = 0.04  # share of such readings
MAX_ONE_SIDED_SDS = 4.5  # standard deviations of a fair coin for "all on one side"; honest: at most 2.8
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
}


class Contradiction(StrEnum):
    """Why readings are not used; the value is the reason that is counted and shown."""

    SENDERS_DISAGREE = "senders disagree"
    ALTERNATING = "values alternate"
    FASTER = "faster than its own rate"
    CHANGED = "a constant changed"


def is_disagreement(
    t: Floats, value: Floats, other_t: Floats, other_value: Floats, magnitude: float, step: float
) -> bool | None:
    """Whether two senders differ in the mean by more than lateness, resolution and calibration explain.

    None where they do not send at the same time.

    Parameters
    ----------
    t, value
        Readings (n,) of one sender: times [s], ascending, and values [SI].
    other_t, other_value
        Readings (m,) of the other.
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


def is_alternating(value: Floats, magnitude: float, step: float) -> bool:
    """Whether consecutive readings (n,) of one address look like those of two senders in turn.

    Of two senders in strict turn, every other reading is closer than the next one; of any other mixture, readings
    stand out from both their neighbours, all on the same side where one of the two sends much more often. Resolution
    and noise do neither.
    """
    if len(value) < MIN_READINGS:
        return False
    size = max(magnitude, float(np.abs(value).mean()))
    steps = np.diff(value)
    next_step, next_but_one = np.abs(steps).mean(), np.abs(value[2:] - value[:-2]).mean()
    if next_step > step + TOLERANCE / 2 * size and next_step > MAX_STEP_RATIO * next_but_one:
        return True
    beyond = np.where(steps[:-1] * steps[1:] < 0, np.minimum(np.abs(steps[:-1]), np.abs(steps[1:])), 0.0)
    if np.count_nonzero(beyond > QUANTA * step + MIN_MATERIAL_STEP * size) > MAX_MATERIAL_SHARE * len(value):
        return True
    out = np.flatnonzero(beyond > SLIGHT_QUANTA * step + MIN_SLIGHT_STEP * size)
    sides = np.sign(steps[out])
    one_sided = max(abs(sides.sum()), abs((sides * np.sign(value[out + 1])).sum()))
    return len(out) > MIN_SLIGHT_SHARE * len(value) and bool(one_sided >= MAX_ONE_SIDED_SDS * np.sqrt(len(out)))


def is_flickering(value: Floats) -> bool:
    """Whether a switch or gear (n,) changes more often in a block than a driver or a gearbox can."""
    return int(np.count_nonzero(np.diff(value))) > MAX_CHANGES

"""Which rows may become samples: each one that may not has one named reason."""

from collections import Counter
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from estimator.samples import STEP, Rows, Samples
from estimator.settings import Admission
from estimator.signals import Floats, Mask, Role


class Reason(StrEnum):
    """Why a row is not used, in order of precedence."""

    SPEED_STALE = "speed stale"
    SPEED_NOT_AVAILABLE = "speed not available"
    SPEED_IMPLAUSIBLE = "speed jumps"
    STANDING = "standing"
    REVERSE = "reverse"
    BRAKING = "braking"
    RETARDER = "retarder"
    SHIFTING = "clutch or shift"
    POWER_STALE = "power stale"
    POWER_NOT_AVAILABLE = "power not available"
    NEAR_EXCLUDED = "near an excluded moment"
    INCOMPLETE = "surroundings incomplete"
    BELOW_MODEL_POWER = "below model power"
    EVICTED = "evicted from the window"


ADMITTED = -1  # code of a row without a reason
_ORDER = tuple(Reason)
BRAKE_PEDAL = 0.005  # fraction of travel: one bit of SPN 521 is 0.4 %
RETARDER_TORQUE = -0.01  # fraction of reference torque: one bit of SPN 520


def row_reasons(rows: Rows, admission: Admission) -> NDArray[np.int8]:
    """Code of the first reason against each row (n,), or ADMITTED.

    Roles that the bus does not carry exclude nothing; neither does a switch that is not available.
    """
    blank = np.full(len(rows), np.nan)

    def context(role: Role) -> Floats:
        return rows.context.get(role, blank)

    gear = context(Role.GEAR)
    pedal, switch = context(Role.BRAKE_PEDAL), context(Role.BRAKE_SWITCH)
    shifting = (context(Role.SHIFT_IN_PROCESS) == 1) | (context(Role.DRIVELINE_ENGAGED) == 0)
    shifting |= (context(Role.CLUTCH_SWITCH) == 1) | (gear == 0)
    braking = (switch == 1) | (pedal > BRAKE_PEDAL) | (context(Role.PARK_BRAKE) == 1)
    retarding = context(Role.RETARDER_FRACTION) < RETARDER_TORQUE
    with np.errstate(invalid="ignore"):
        standing = rows.speed < admission.minimum_speed_m_s
    masks: dict[Reason, Mask] = {
        Reason.SPEED_STALE: ~rows.fresh[:, 0],
        Reason.SPEED_NOT_AVAILABLE: np.isnan(rows.speed),
        Reason.SPEED_IMPLAUSIBLE: np.isnan(rows.plausible_speed),
        Reason.STANDING: standing,
        Reason.REVERSE: gear < 0,
        Reason.BRAKING: braking,
        Reason.RETARDER: retarding,
        Reason.SHIFTING: shifting,
        Reason.POWER_STALE: ~rows.fresh[:, 1],
        Reason.POWER_NOT_AVAILABLE: np.isnan(rows.power),
        Reason.NEAR_EXCLUDED: _around(braking | retarding | shifting, round(admission.margin_s / STEP)),
    }
    codes = np.full(len(rows), ADMITTED, dtype=np.int8)
    for reason, mask in reversed(masks.items()):
        codes[mask] = _ORDER.index(reason)
    return codes


def admit(samples: Samples, codes: NDArray[np.int8], rejected: Counter[str]) -> Samples:
    """Samples whose rows have no reason against them and whose surroundings are complete; counts the others."""
    codes = np.where((codes == ADMITTED) & ~samples.complete, _ORDER.index(Reason.INCOMPLETE), codes)
    values, counts = np.unique(codes, return_counts=True)
    for code, count in zip(values.tolist(), counts.tolist(), strict=True):
        if code != ADMITTED:
            rejected[_ORDER[code]] += count
    return samples[codes == ADMITTED]


def _around(mask: Mask, reach: int) -> Mask:
    """True within ``reach`` rows of a true row."""
    count = np.concatenate([[0], np.cumsum(mask)])
    n = len(mask)
    i = np.arange(n)
    return count[np.minimum(i + reach + 1, n)] > count[np.maximum(i - reach, 0)]

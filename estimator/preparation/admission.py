"""Admission of rows to strides; each row that is not admitted has one named reason."""

from collections import Counter
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from estimator.samples import STEP, Rows
from estimator.settings import Admission
from estimator.signals import Floats, Mask, Quantity, Role


class Reason(StrEnum):
    """Reason why a row is not used, in order of precedence."""

    SPEED_STALE = "speed stale"
    WHEELS_CONTRADICT = "wheel speeds contradict each other"
    SPEED_NOT_AVAILABLE = "speed not available"
    FROZEN = "speed and power frozen"
    SPEED_IMPLAUSIBLE = "speed jumps"
    STANDING = "standing"
    REVERSE = "reverse"
    BRAKING = "braking"
    RETARDER = "retarder"
    SHIFTING = "clutch or shift"
    POWER_STALE = "power stale"
    POWER_NOT_AVAILABLE = "power not available"
    NEAR_EXCLUDED = "near an excluded moment"
    MAY_BRAKE = "no power, and brakes are not on the bus"
    INCOMPLETE = "surroundings incomplete"
    EVICTED = "evicted from the window"


ADMITTED = -1  # code of a row without a reason
_ORDER = tuple(Reason)
MAY_BRAKE = np.int8(_ORDER.index(Reason.MAY_BRAKE))  # code of that reason
BRAKE_PEDAL = 0.005  # fraction of travel: one bit of SPN 521 is 0.4 %
RETARDER_TORQUE = -0.01  # fraction of reference torque: one bit of SPN 520
UNSEEN_MARGIN = 2.0  # s, kept away from moments without power where no brake is on the bus: rows of tables are as rare


def row_reasons(rows: Rows, admission: Admission) -> NDArray[np.int8]:
    """Code (n,) of the first reason against each row, or ADMITTED.

    Missing roles and switches without a value exclude no row.
    """
    blank = np.full(len(rows), np.nan)

    def context(role: Role) -> Floats:
        return rows.context.get(role, blank)

    shifting, braking = is_shifting(rows), is_braking(rows)
    margin = round(admission.stride_margin_s / STEP)
    retarding = context(Role.RETARDER_FRACTION) < RETARDER_TORQUE
    with np.errstate(invalid="ignore"):
        standing = rows.speed < admission.minimum_speed_m_s
    masks: dict[Reason, Mask] = {
        Reason.SPEED_STALE: ~rows.fresh[:, 0],
        Reason.WHEELS_CONTRADICT: rows.derived.get(Quantity.CONTRADICTED, blank) == 1.0,
        Reason.SPEED_NOT_AVAILABLE: np.isnan(rows.speed),
        Reason.FROZEN: rows.frozen,
        Reason.SPEED_IMPLAUSIBLE: np.isnan(rows.plausible_speed),
        Reason.STANDING: standing,
        Reason.REVERSE: context(Role.GEAR) < 0,
        Reason.BRAKING: braking,
        Reason.RETARDER: retarding,
        Reason.SHIFTING: shifting,
        Reason.POWER_STALE: ~rows.fresh[:, 1],
        Reason.POWER_NOT_AVAILABLE: np.isnan(rows.power),
        Reason.NEAR_EXCLUDED: near(braking | retarding | shifting | rows.frozen, margin),
    }
    codes = np.full(len(rows), ADMITTED, dtype=np.int8)
    for reason, mask in reversed(masks.items()):
        codes[mask] = _ORDER.index(reason)
    return codes


def shows_brakes(rows: Rows) -> bool:
    """True if a brake switch or pedal is on the bus; else, brakes may be used whenever there is no power."""
    return bool(rows.context.keys() & {Role.BRAKE_SWITCH, Role.BRAKE_PEDAL})


def margin_of(rows: Rows, admission: Admission) -> int:
    """Number of rows kept away from moments that are excluded, or that may be braking."""
    least = 0.0 if shows_brakes(rows) else UNSEEN_MARGIN
    return round(max(admission.stride_margin_s, least) / STEP)


def is_braking(rows: Rows) -> Mask:
    """Mask (n,) of rows with a brake applied, by brake switch, pedal or parking brake."""
    blank = np.full(len(rows), np.nan)
    pedal, switch, park = (
        rows.context.get(role, blank) for role in (Role.BRAKE_PEDAL, Role.BRAKE_SWITCH, Role.PARK_BRAKE)
    )
    used: Mask = (switch == 1) | (pedal > BRAKE_PEDAL) | (park == 1)
    return used


def is_shifting(rows: Rows) -> Mask:
    """Mask (n,) of rows in which the driveline may be open: gear change, clutch or neutral."""
    blank = np.full(len(rows), np.nan)
    shift, engaged, clutch, gear = (
        rows.context.get(role, blank)
        for role in (Role.SHIFT_IN_PROCESS, Role.DRIVELINE_ENGAGED, Role.CLUTCH_SWITCH, Role.GEAR)
    )
    open_: Mask = (shift == 1) | (engaged == 0) | (clutch == 1) | (gear == 0)
    return open_


def is_coasting(rows: Rows, margin: int) -> Mask:
    """Mask (n,) of rows in which the driveline is open, so that the engine gives no force.

    The bus must signal neutral, a disengaged driveline and no gear change in process, for ``margin`` rows on either
    side.
    """
    blank = np.full(len(rows), np.nan)
    shift, engaged, gear = (
        rows.context.get(role, blank) for role in (Role.SHIFT_IN_PROCESS, Role.DRIVELINE_ENGAGED, Role.GEAR)
    )
    open_ = (shift == 0) & (engaged == 0) & (gear == 0)
    coasting: Mask = open_ & ~near(~open_ | is_braking(rows), margin)
    return coasting


def count_reasons(codes: NDArray[np.int8], rejected: Counter[str]) -> None:
    """Count unused rows by their ``codes`` (n,); ADMITTED ones are counted as INCOMPLETE."""
    codes = np.where(codes == ADMITTED, _ORDER.index(Reason.INCOMPLETE), codes)
    for code, count in zip(*(x.tolist() for x in np.unique(codes, return_counts=True)), strict=True):
        rejected[_ORDER[code]] += count


def near(mask: Mask, reach: int) -> Mask:
    """Mask (n,) of rows within ``reach`` rows of a True row of ``mask`` (n,)."""
    count = np.concatenate([[0], np.cumsum(mask)])
    n = len(mask)
    i = np.arange(n)
    return count[np.minimum(i + reach + 1, n)] > count[np.maximum(i - reach, 0)]

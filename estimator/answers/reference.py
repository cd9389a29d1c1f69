"""Estimates of other control units, beside ours in the answers of `estimate`, `replay`, `diagnose` and `status`."""

from msgspec import Struct


class Reference(Struct, frozen=True, kw_only=True):
    """Estimate of another control unit, in the unit that its key names; ours does not depend on it.

    ``lowest`` and ``highest`` of the newest hour. ``difference`` from ours, positive where it lies above: of a mass
    that of the newest reading, with our standard deviation; of a grade the mean and standard deviation over the strides
    of the window. Null where ours is not known.
    """

    signal: str
    readings: int
    age_s: float
    newest: float
    lowest: float
    highest: float
    difference: float | None = None
    difference_sd: float | None = None


class References(Struct, frozen=True, kw_only=True):
    """Those whose roles are bound and that have come."""

    mass_kg: Reference | None = None
    grade_percent: Reference | None = None

"""The estimate as signals of COVESA's Vehicle Signal Specification: one of the standard's, and those of the overlay.

The overlay is shipped as ``roadload.vspec``, with the unit that it needs in ``roadload.units.yaml``.
"""

from dataclasses import dataclass
from typing import Literal

from estimator.answers.published import PublishedAnswer, Usability

WEIGHT = "Vehicle.CurrentOverallWeight"  # [kg] of the standard: 16 bits
MAX_WEIGHT = 65_535  # kg
BRANCH = "Vehicle.RoadLoad"  # of the overlay
PARAMETERS = {"Mass": "mass_kg", "RollingResistance": "A_N", "Drag": "C_N_s2_m2"}
MOMENTS = {"Mean": "mean", "Low": "q05", "High": "q95"}

Kind = Literal["uint32", "float", "string"]  # of the value in the protocol, which has no type of 16 bits


@dataclass(frozen=True, slots=True)
class Signal:
    """Path, kind and value of a signal; no value where it is not available."""

    path: str
    kind: Kind
    value: float | int | str | None


def signals(report: PublishedAnswer | None, overlay: bool) -> list[Signal]:
    """The signals of a report, or of none; the standard's mass is not available beyond what it can say."""
    status = Usability.UNESTIMATED if report is None else report.status
    estimate = report.estimate if report is not None and status is Usability.ESTIMATED else None
    mass = None if estimate is None else estimate.parameters.mass_kg.mean
    weight = None if mass is None or round(mass) > MAX_WEIGHT else round(mass)
    listed = [Signal(WEIGHT, "uint32", weight)]
    if not overlay:
        return listed
    listed.append(Signal(f"{BRANCH}.Status", "string", status.value.upper()))
    for name, key in PARAMETERS.items():
        parameter = None if estimate is None else getattr(estimate.parameters, key)
        word = status.value if parameter is None else parameter.status.value
        listed.append(Signal(f"{BRANCH}.{name}.Status", "string", word.upper()))
        for moment, attribute in MOMENTS.items():
            value = None if parameter is None else getattr(parameter, attribute)
            listed.append(Signal(f"{BRANCH}.{name}.{moment}", "float", value))
    return listed

"""Values of signals in the units in which people read them: km/h, degrees, degrees Celsius."""

from estimator.report.number_format import clock, exponent, rounded
from estimator.roles import DIMENSION, STATE, Role
from estimator.units import KMH, conversion_of

USUAL = {  # by dimension: the unit, and its spelling in `units`
    "m/s": ("km/h", "km/h"),
    "W": ("kW", "kw"),
    "N.m": ("N m", "n.m"),
    "rad/s": ("rpm", "rpm"),
    "1": ("%", "%"),
    "kg": ("kg", "kg"),
    "m": ("m", "m"),
    "m/s^2": ("m/s²", "m/s^2"),
    "rad": ("°", "deg"),
    "K": ("°C", "degc"),
    "Pa": ("hPa", "hpa"),
    "V": ("V", "v"),
    "A": ("A", "a"),
}
SHOWN = {"m/s": (KMH, " km/h"), "m/s^2": (1.0, " m/s²"), "deg": (1.0, "°"), "degC": (1.0, " °C")}  # along an axis
PER_SECOND = ("°/s", "deg/s")  # of turning vehicles, unlike shafts


def ends(start: float, end: float, unit: str) -> tuple[str, str]:
    """``66.2 km/h`` and ``74.0 km/h`` for 18.4 and 20.56 m/s: to two digits of their difference; other units stay.

    Times are shown on a clock: ``0:35:01`` for 2,101 s.
    """
    if unit == "s":
        return clock(start), clock(end)
    factor, shown = SHOWN.get(unit, (1.0, f" {unit}"))
    low, high = factor * start, factor * end
    decimals = 0 if low.is_integer() and high.is_integer() else max(1 - exponent(high - low), 0)
    return f"{rounded(low, decimals)}{shown}".strip(), f"{rounded(high, decimals)}{shown}".strip()


def between(role: Role, low: float, high: float) -> str:
    """``0 .. 90.5 km/h`` for values from ``low`` to ``high`` in the SI unit of ``role``."""
    dimension = DIMENSION[role]
    if dimension == STATE:
        return f"{low:.4g} .. {high:.4g}"
    unit, spelling = PER_SECOND if role is Role.YAW_RATE else USUAL[dimension]
    conversion = conversion_of(spelling)
    assert conversion is not None  # of the table above
    first, last = ((value - conversion.offset) / conversion.scale for value in (low, high))
    return f"{first:.4g} .. {last:.4g} {unit}"

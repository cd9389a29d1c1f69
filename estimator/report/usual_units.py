"""Values of signals in the units in which people read them: km/h, degrees, degrees Celsius."""

from estimator.report.number_format import number
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


def with_unit(value: float, unit: str) -> str:
    """``90 km/h`` for 25 m/s, ``12 °C`` for 12 degC; other units stay."""
    factor, shown = SHOWN.get(unit, (1.0, f" {unit}"))
    return f"{number(factor * value)}{shown}".strip()


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

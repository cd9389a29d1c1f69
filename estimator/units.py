"""Unit strings as DBC files write them, and their conversion to SI."""

from dataclasses import dataclass
from math import pi

STANDARD_GRAVITY = 9.80665  # m/s^2, ISO 80000-3
HOUR = 3600.0  # s
EARTH_RADIUS = 6.371e6  # m, of a sphere: cells and short ways need no ellipsoid


@dataclass(frozen=True, slots=True)
class Conversion:
    """``SI = scale * value + offset``; ``dimension`` is the SI unit it leads to."""

    dimension: str
    scale: float
    offset: float = 0.0


# Keys are compared without case and without blanks; every spelling below occurs in public DBC files.
_SPELLINGS: list[tuple[str, Conversion]] = [
    ("m/s mps", Conversion("m/s", 1.0)),
    ("km/h kph kmh kmph", Conversion("m/s", 1 / 3.6)),
    ("mph mi/h", Conversion("m/s", 0.44704)),
    ("kt kts knot knots", Conversion("m/s", 1852 / 3600)),
    ("m/s^2 m/s2 m/s² mps2 m/s/s", Conversion("m/s^2", 1.0)),
    ("g gn", Conversion("m/s^2", STANDARD_GRAVITY)),
    ("rad/s", Conversion("rad/s", 1.0)),
    ("rpm 1/min r/min min^-1 u/min", Conversion("rad/s", 2 * pi / 60)),
    ("deg/s °/s degree/s", Conversion("rad/s", pi / 180)),
    ("nm n.m n·m n*m newton-meter", Conversion("N.m", 1.0)),
    ("lbft lb-ft lbf.ft ft-lb ftlb", Conversion("N.m", 1.3558179483314004)),
    ("w", Conversion("W", 1.0)),
    ("kw", Conversion("W", 1e3)),
    ("hp bhp", Conversion("W", 745.6998715822702)),
    ("ps cv", Conversion("W", 735.49875)),
    ("% percent pct", Conversion("1", 0.01)),
    ("1 - ratio", Conversion("1", 1.0)),
    ("deg ° degree degrees", Conversion("rad", pi / 180)),
    ("rad", Conversion("rad", 1.0)),
    ("m", Conversion("m", 1.0)),
    ("km", Conversion("m", 1e3)),
    ("ft", Conversion("m", 0.3048)),
    ("mi", Conversion("m", 1609.344)),
    ("degc °c deg.c celsius c", Conversion("K", 1.0, 273.15)),
    ("degf °f fahrenheit f", Conversion("K", 5 / 9, 273.15 - 32 * 5 / 9)),
    ("k kelvin", Conversion("K", 1.0)),
    ("pa", Conversion("Pa", 1.0)),
    ("kpa", Conversion("Pa", 1e3)),
    ("hpa mbar", Conversion("Pa", 1e2)),
    ("bar", Conversion("Pa", 1e5)),
    ("psi", Conversion("Pa", 6894.757293168361)),
    ("kg", Conversion("kg", 1.0)),
    ("t", Conversion("kg", 1e3)),
    ("lb lbs lbm", Conversion("kg", 0.45359237)),
    ("v", Conversion("V", 1.0)),
    ("a", Conversion("A", 1.0)),
]
KNOWN_UNITS: dict[str, Conversion] = {
    spelling: conversion for spellings, conversion in _SPELLINGS for spelling in spellings.split()
}


def conversion_of(unit: str | None) -> Conversion | None:
    """Conversion for a DBC unit string, or None when the string is not known."""
    return KNOWN_UNITS.get((unit or "").replace(" ", "").lower())

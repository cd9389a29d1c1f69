"""Unit strings as DBC files write them, and their conversion to SI."""

import re
import unicodedata
from dataclasses import dataclass
from math import pi

STANDARD_GRAVITY = 9.80665  # m/s^2, ISO 80000-3
HOUR = 3600.0  # s
KMH = 3.6  # km/h in 1 m/s
STANDARD_DENSITY = 1.225  # kg/m^3, of air at sea level, ISO 2533
EARTH_RADIUS = 6.371e6  # m, of a sphere: cells and short ways need no ellipsoid


@dataclass(frozen=True, slots=True)
class Conversion:
    """``SI = scale * value + offset``; ``dimension`` is the SI unit it leads to."""

    dimension: str
    scale: float
    offset: float = 0.0


# The first spelling of a line is the one that complaints show. Spellings are compared in their `normal_form`.
_SPELLINGS: list[tuple[str, Conversion]] = [
    ("km/h kph kmh kmph", Conversion("m/s", 1 / 3.6)),
    ("m/s mps", Conversion("m/s", 1.0)),
    ("mph mi/h", Conversion("m/s", 0.44704)),
    ("kt kts", Conversion("m/s", 1852 / 3600)),
    ("ft/s fps", Conversion("m/s", 0.3048)),
    ("yd/s", Conversion("m/s", 0.9144)),
    ("m/s^2 mps2 m/s/s", Conversion("m/s^2", 1.0)),
    ("g gn", Conversion("m/s^2", STANDARD_GRAVITY)),
    ("rpm 1/min r/min min^-1 u/min umin upm", Conversion("rad/s", 2 * pi / 60)),
    ("rad/s", Conversion("rad/s", 1.0)),
    ("deg/s °/s dps", Conversion("rad/s", pi / 180)),
    ("r/s u/s rps", Conversion("rad/s", 2 * pi)),
    ("Nm", Conversion("N.m", 1.0)),
    ("kNm", Conversion("N.m", 1e3)),
    ("cNm", Conversion("N.m", 1e-2)),
    ("lbft lbfft ftlb ftlbf ftlbs lbsft", Conversion("N.m", 1.3558179483314004)),
    ("kW", Conversion("W", 1e3)),
    ("W", Conversion("W", 1.0)),
    ("hp bhp", Conversion("W", 745.6998715822702)),
    ("PS cv", Conversion("W", 735.49875)),
    ("% pct", Conversion("1", 0.01)),
    ("1 - ratio", Conversion("1", 1.0)),
    ("deg °", Conversion("rad", pi / 180)),
    ("rad", Conversion("rad", 1.0)),
    ("mrad", Conversion("rad", 1e-3)),
    ("m", Conversion("m", 1.0)),
    ("km", Conversion("m", 1e3)),
    ("cm", Conversion("m", 1e-2)),
    ("mm", Conversion("m", 1e-3)),
    ("ft", Conversion("m", 0.3048)),
    ("mi", Conversion("m", 1609.344)),
    ("°C degc c", Conversion("K", 1.0, 273.15)),
    ("°F degf f", Conversion("K", 5 / 9, 273.15 - 32 * 5 / 9)),
    ("K degk °k", Conversion("K", 1.0)),
    ("kPa", Conversion("Pa", 1e3)),
    ("Pa", Conversion("Pa", 1.0)),
    ("hPa mbar", Conversion("Pa", 1e2)),
    ("bar", Conversion("Pa", 1e5)),
    ("MPa", Conversion("Pa", 1e6)),
    ("psi", Conversion("Pa", 6894.757293168361)),
    ("mmHg", Conversion("Pa", 101_325 / 760)),
    ("kg kgram kgrams kilogram kilograms", Conversion("kg", 1.0)),
    ("t", Conversion("kg", 1e3)),
    ("lb lbs lbm", Conversion("kg", 0.45359237)),
    ("V vdc", Conversion("V", 1.0)),
    ("mV", Conversion("V", 1e-3)),
    ("kV", Conversion("V", 1e3)),
    ("A adc", Conversion("A", 1.0)),
    ("mA", Conversion("A", 1e-3)),
]
_NAMES: dict[str, str] = {
    "meter metre": "m",
    "mile": "mi",
    "foot feet": "ft",
    "yard": "yd",
    "knot": "kt",
    "second sec sek sekunde": "s",
    "minute": "min",
    "hour hr stunde": "h",
    "per pro": "/",
    "squared square": "2",
    "inverse": "-1",
    "of arc force": "",
    "newton": "n",
    "watt": "w",
    "pascal": "pa",
    "volt": "v",
    "amp ampere": "a",
    "pound": "lb",
    "gravity": "g",
    "kelvin": "k",
    "celsius": "c",
    "fahrenheit": "f",
    "radian rads": "rad",
    "degree grad": "deg",
    "revolution rev turn": "r",
    "percent percentage prozent": "%",
}
# Names may have a plural, and some makers cut them after five letters, as in Unit_MeterPerSeconSquar.
_WORDS: dict[str, str] = {
    form: sign for names, sign in _NAMES.items() for name in names.split() for form in (name, f"{name}s", name[:5])
}
_PREFIXES = {"kilo": "k", "hecto": "h", "centi": "c", "milli": "m", "micro": "u", "nano": "n", "mega": "M"}
_REPLACED = {  # also degree signs in wrong encodings
    "\N{MULTIPLICATION SIGN}": "*",
    "Â": "",
    "\N{REPLACEMENT CHARACTER}": "°",
    "º": "°",
}
_RUN = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[^\W_]|[^\w\s]")


def normal_form(unit: str) -> str:
    """A unit without case, blanks, signs of multiplication and powers, the prefix of its maker, and written-out names.

    "Unit_KiloMeterPerHour", "torque:N.m", "[deg C]", "N-m" and "m/s²" become "km/h", "nm", "degc", "nm" and "m/s2".
    """
    for wrong, right in _REPLACED.items():
        unit = unit.replace(wrong, right)
    text = unicodedata.normalize("NFKC", unit).strip().strip("[]()")
    if text == "-":
        return "1"
    text = text.rpartition(":")[2]  # a quantity before it
    text = re.sub(r"^units?[_ ]+", "", text, flags=re.IGNORECASE)
    text = re.sub(r"per[_ ]?cent(?!i)", "%", text, flags=re.IGNORECASE)
    return re.sub(r"[\s_.^*·⋅-]", "", "".join(map(_symbol, _RUN.findall(text))).lower())


def _symbol(word: str) -> str:
    """The sign of a unit that is written out, or the word itself."""
    name = word.lower()
    for prefix, sign in _PREFIXES.items():
        if name == prefix:
            return sign
        if name.startswith(prefix) and (found := _WORDS.get(name.removeprefix(prefix))):
            return sign + found
    return _WORDS.get(name, word)


KNOWN_UNITS: dict[str, Conversion] = {
    spelling: conversion for spellings, conversion in _SPELLINGS for spelling in spellings.split()
}
_BY_NORMAL_FORM: dict[str, Conversion] = {normal_form(spelling): unit for spelling, unit in KNOWN_UNITS.items()}


def conversion_of(unit: str | None) -> Conversion | None:
    """Conversion for a DBC unit string, or None when the string is not known."""
    return _BY_NORMAL_FORM.get(normal_form(unit or ""))


def spellings_of(dimension: str) -> list[str]:
    """The usual spelling of each unit of a dimension."""
    return [spellings.split()[0] for spellings, unit in _SPELLINGS if unit.dimension == dimension]

"""Numbers for people: shares in per cent, as many digits as the uncertainty supports, no long zeros."""

import math

MINUS = "\N{MINUS SIGN}"
NOTHING = "\N{EN DASH}"
TIMES = "\N{MULTIPLICATION SIGN}"
SHARES = {"1": "%", "1/h": "%/h"}  # units of relative quantities, and their units in per cent
PREFIXED = frozenset({"W"})  # units that are read in thousands
MAX_PLAIN, MIN_PLAIN = 1e3, 1e-3  # beyond which a value is read in powers of a thousand
MIN_POWER, MAX_DECIMALS = -24, 12  # smaller than that is nothing
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def in_unit(size: float, unit: str) -> tuple[float, str]:
    """Factor by which a value of about this ``size`` [unit] is read easily, and the unit it then has."""
    if unit in SHARES:
        return 100.0, SHARES[unit]
    if unit in PREFIXED and abs(size) >= MAX_PLAIN:
        return 1e-3, f"k{unit}"
    if 0 < abs(size) < MIN_PLAIN:
        power = max(3 * math.floor(math.log10(abs(size)) / 3), MIN_POWER)
        return 10.0**-power, f"{TIMES}10{str(power).translate(SUPERSCRIPTS)} {unit}".strip()
    return 1.0, unit


def with_sd(value: float, sd: float, unit: str) -> str:
    """``27,860 ± 540 kg``: two digits of the standard deviation, and the value as far; three digits without one."""
    if not math.isfinite(value):
        return NOTHING
    known = math.isfinite(sd) and sd > 0
    factor, shown = in_unit(max(abs(value), sd) if known else value, unit)
    value, sd = factor * value, factor * sd
    decimals = 1 - exponent(sd) if known else max(2 - exponent(value), 0)
    spread = f" ± {rounded(sd, decimals)}" if known else ""
    return f"{rounded(value, decimals)}{spread} {shown}".strip()


def with_interval(value: float, low: float, high: float, unit: str) -> str:
    """``27,900 kg (27,200 .. 28,600)``, to a hundredth of the interval."""
    width = high - low
    if not math.isfinite(value + width):
        return NOTHING
    factor, shown = in_unit(max(abs(low), abs(high)), unit)
    decimals = 2 - exponent(factor * (width if width > 0 else value))
    middle, lower, upper = (rounded(factor * x, decimals) for x in (value, low, high))
    return f"{middle} {shown}".strip() + f" ({lower} .. {upper})"


def number(x: float) -> str:
    """Three or four significant digits, no exponent where a person would write none."""
    if not math.isfinite(x):
        return NOTHING
    if x != 0 and not 1e-3 <= abs(x) < 1e7:
        return signed(f"{x:.2e}")
    return signed(f"{x:,.0f}" if abs(x) >= 1000 else f"{x:.3g}")


def rounded(x: float, decimals: int) -> str:
    """To so many decimals, or to tens, hundreds where they are negative."""
    return signed(f"{round(x, decimals):,.{min(max(decimals, 0), MAX_DECIMALS)}f}")


def counted(count: int, what: str) -> str:
    """A number of things: `1 drive`, `1,020 drives`."""
    return f"{count:,} {what}{'s' * (count != 1)}"


def clock(seconds: float) -> str:
    """``1:02:05``, hours, minutes and seconds."""
    if not math.isfinite(seconds):
        return NOTHING
    whole = max(round(seconds), 0)
    return f"{whole // 3600}:{whole // 60 % 60:02}:{whole % 60:02}"


def signed(text: str) -> str:
    """A true minus sign, none before a number that is all zeros."""
    if text.startswith("-"):
        return text[1:] if not any(c in "123456789" for c in text) else MINUS + text[1:]
    return text


def exponent(x: float) -> int:
    """Decimal exponent of the first digit; 0 for zero."""
    return math.floor(math.log10(abs(x))) if x else 0

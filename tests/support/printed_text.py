"""Comparison of printed pages with newly computed text."""

import re

ROUNDED = 0.02  # share of a number that its trailing zeros may stand for
NUMBER = re.compile(r"\d[\d,]*\.?\d*(?:e[-+]\d+)?")


def assert_same(computed: str, printed: str, rtol: float = 0.0) -> None:
    """Require the same words; numbers may differ by one unit of the last printed digit, or by ``rtol`` of the value.

    With a tolerance a number that is rounded to tens or hundreds may differ by one of them.
    """
    computed, printed = (" ".join(text.split()) for text in (computed, printed))
    assert NUMBER.sub("0", computed) == NUMBER.sub("0", printed)
    for new, old in zip(NUMBER.findall(computed), NUMBER.findall(printed), strict=True):
        mantissa, _, exponent = old.partition("e")
        unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
        a, b = (float(number.replace(",", "")) for number in (new, old))
        zeros = 10.0 ** (len(mantissa) - len(mantissa.rstrip("0"))) if rtol and "." not in mantissa else 1.0
        assert abs(a - b) <= max(1.01 * unit, min(1.01 * unit * zeros, ROUNDED * abs(b)), rtol * abs(b)), (new, old)

"""Printed pages beside what is computed anew."""

import re

NUMBER = re.compile(r"\d[\d,]*\.?\d*(?:e[-+]\d+)?")


def assert_same(computed: str, printed: str, rtol: float = 0.0) -> None:
    """Same words; numbers may differ by one unit of the last printed digit, or by ``rtol`` of the value."""
    computed, printed = (" ".join(text.split()) for text in (computed, printed))
    assert NUMBER.sub("0", computed) == NUMBER.sub("0", printed)
    for new, old in zip(NUMBER.findall(computed), NUMBER.findall(printed), strict=True):
        mantissa, _, exponent = old.partition("e")
        unit = 10.0 ** (int(exponent or 0) - len(mantissa.partition(".")[2]))
        a, b = (float(number.replace(",", "")) for number in (new, old))
        assert abs(a - b) <= max(1.01 * unit, rtol * abs(b)), (new, old)

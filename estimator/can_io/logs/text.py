"""Treatment of invalid text, and of a cut last line, for readers of python-can."""

from string import hexdigits

READER_ERRORS = (ValueError, IndexError, KeyError, TypeError, OverflowError, NotImplementedError)  # on bad text
CUT = "the file ends inside this line; end it with a line break if it is whole"


def is_digit_missing(line: str, data: bytearray, digits: int = 2, base: int = 16) -> bool:
    """True if a line without a line break ends within its last payload byte, which lacks a digit."""
    last = line.split()[-1]
    short = not line.endswith("\n") and len(last) < digits and all(digit in hexdigits for digit in last)
    return short and len(data) > 0 and int(last, base) == data[-1]

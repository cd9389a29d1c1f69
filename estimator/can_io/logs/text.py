"""What readers of python-can make of bad text, and of a last line that is cut."""

from string import hexdigits

READER_ERRORS = (ValueError, IndexError, KeyError, TypeError, OverflowError, NotImplementedError)  # on bad text
CUT = "the file ends inside this line; end it with a line break if it is whole"


def is_digit_missing(line: str, data: bytearray, digits: int = 2, base: int = 16) -> bool:
    """Whether a line has no line break and ends in its last payload byte, with fewer digits than bytes have."""
    last = line.split()[-1]
    short = not line.endswith("\n") and len(last) < digits and all(digit in hexdigits for digit in last)
    return short and len(data) > 0 and int(last, base) == data[-1]

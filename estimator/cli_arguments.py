"""Values on the command line: what is not one is refused in one line."""

import argparse
import sys
from collections.abc import Callable


def number(low: float, high: float, what: str) -> Callable[[str], float]:
    """A parser of numbers from ``low`` to ``high``, called ``what`` in the complaint."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = float("nan")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text!r} is not {what}")
        return value

    return parse


positive = number(sys.float_info.min, sys.float_info.max, "a positive number")
not_negative = number(0.0, sys.float_info.max, "a number that is not negative")


def seed(text: str) -> int:
    """A seed of a random generator."""
    if not text.isascii() or not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number that is not negative")
    return int(text)

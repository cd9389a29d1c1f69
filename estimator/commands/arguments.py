"""Arguments that several subcommands take, and their values: a wrong one is refused in one line."""

import argparse
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path


def add_output(parser: argparse.ArgumentParser) -> None:
    """Add --json and --debug."""
    parser.add_argument("--json", action="store_true", help="one JSON object on standard output")
    add_debug(parser)


def add_debug(parser: argparse.ArgumentParser) -> None:
    """Add --debug."""
    parser.add_argument("--debug", action="store_true", help="show a traceback on errors")


def add_settings(parser: argparse.ArgumentParser) -> None:
    """Add --config and --dbc."""
    parser.add_argument(
        "--config", type=Path, metavar="FILE.toml", help="settings and signal binding; obd2: as shipped"
    )
    parser.add_argument("--dbc", action="append", metavar="FILE.dbc", help="instead of the configuration's databases")


def add_print_config(parser: argparse.ArgumentParser) -> None:
    """Add --print-config."""
    parser.add_argument("--print-config", action="store_true", help="print the settings in force as TOML, and stop")


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
MINUTES = number(0.5, 10_000.0, "a number of minutes from 0.5 to 10000")
not_negative = number(0.0, sys.float_info.max, "a number that is not negative")


def whole_number(text: str) -> int:
    """A number of something, or a seed of a random generator."""
    if not text.isascii() or not text.isdigit():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number that is not negative")
    return int(text)


def moment(text: str) -> float:
    """A date and time of the years 1971 to 2099 as seconds since 1970 [s]."""
    try:
        given = datetime.fromisoformat(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no date and time as in 2026-03-01T06:00") from None
    if not 1970 < given.year < 2100:
        raise argparse.ArgumentTypeError(f"{text!r} is not in the years 1971 to 2099")
    return (given if given.tzinfo else given.replace(tzinfo=UTC)).timestamp()

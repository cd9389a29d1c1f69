"""Complaints on standard error; apart from the terminal, which takes time to import."""

import sys
import traceback

from estimator.printable import printable


def complain(text: str) -> None:
    """Print one line on standard error."""
    print(printable(" ".join(text.split())), file=sys.stderr)


def show_traceback() -> None:
    """Print the traceback of the error at hand on standard error."""
    print(*map(printable, traceback.format_exc().splitlines()), sep="\n", file=sys.stderr)

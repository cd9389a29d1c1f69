"""Names that a mistyped one may stand for."""

import difflib
from collections.abc import Iterable


def nearest(name: str, there: Iterable[str], count: int = 3) -> list[str]:
    """The names most like ``name``, in falling order, however unlike; letters count in either case."""
    by_lower = {other.lower(): other for other in there}
    return [by_lower[found] for found in difflib.get_close_matches(name.lower(), by_lower, count, cutoff=0)]


def did_you_mean(name: str, there: Iterable[str], beyond: str = "") -> str:
    """A question for the end of a complaint; empty where nothing is like ``name``, ``beyond`` how all names begin."""
    by_lower = {other.lower().removeprefix(beyond): other for other in there if other.startswith(beyond)}
    found = difflib.get_close_matches(name.lower().removeprefix(beyond), by_lower, n=1, cutoff=0.6)
    return f"; did you mean {by_lower[found[0]]}?" if found else ""

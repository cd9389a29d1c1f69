"""A piece of a table: some rows as cells by column; every reader of tables yields such pieces."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

ROWS = 1 << 14  # at once

Wanted = Callable[[Iterable[str]], set[str]]  # of the names that there are, those whose cells are asked for


@dataclass(frozen=True, slots=True)
class Piece:
    """Cells (n,) by name of the column, the share of the file that has been read up to them, and units it gives.

    ``short`` are the indices of rows that have fewer cells than most: which ones they lack is not known.
    """

    cells: Mapping[str, Any]
    progress: float
    units: Mapping[str, str] = field(default_factory=dict)  # of columns, where the file has them beside the names
    short: Sequence[int] = ()

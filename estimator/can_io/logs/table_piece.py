"""A piece of a table: some rows as cells by column; every reader of tables yields such pieces."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

ROWS = 1 << 14  # at once

Wanted = Callable[[Iterable[str]], set[str]]  # of the names that there are, those whose cells are asked for


@dataclass(frozen=True, slots=True)
class Piece:
    """Cells (n,) by name of the column, and the share of the file that has been read up to them."""

    cells: Mapping[str, Any]
    progress: float

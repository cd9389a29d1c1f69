"""Tables of measurements from CSV or Parquet; error messages name row and column."""

import csv
import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from estimator.errors import ConfigError, InputError, RoadloadError
from estimator.signals import Floats, Mask

EMPTY = {"", "na", "n/a", "nan", "null", "none"}  # cells without a value, in any case
NUMBER = r"\d+(?:\.\d*)?(?:[eE][+-]?\d+)?"
SCALED = re.compile(rf"(?P<column>.+?)(?:\*(?P<factor>[+-]?{NUMBER}))?(?P<offset>[+-]{NUMBER})?")


@dataclass(frozen=True)
class Table:
    """Cells (n,) by column, as text or as numbers; ``line`` (n,) are the line numbers in ``path``, for messages."""

    path: Path
    line: list[int]
    cells: dict[str, list[Any]]

    def __len__(self) -> int:
        return len(self.line)

    def column(self, name: str) -> list[Any]:
        """Cells of a column.

        Raises
        ------
        ConfigError
            There is no such column; the message lists the columns.
        """
        if name not in self.cells:
            raise ConfigError(f"{self.path}: no column {name!r}; the columns are {', '.join(map(repr, self.cells))}")
        return self.cells[name]

    def numbers(self, name: str) -> Floats:
        """Values (n,) of a column, NaN where a cell is empty.

        Raises
        ------
        ConfigError
            There is no such column.
        InputError
            A cell is no number; the message names the row.
        """
        values = np.full(len(self), np.nan)
        for i, cell in enumerate(self.column(name)):
            if cell is None or (isinstance(cell, str) and cell.strip().lower() in EMPTY):
                continue
            try:
                values[i] = float(cell)
            except (TypeError, ValueError):
                place = f"{self.path}: row {self.line[i]}, column {name!r}"
                raise InputError(f"{place}: {cell!r} is not a number; correct it, or leave it empty") from None
        return values

    def scaled(self, expression: str) -> Floats:
        """Values (n,) of ``column[*factor][+offset]``; a column of exactly that name takes precedence."""
        match = SCALED.fullmatch(expression)
        if expression in self.cells or match is None:
            return self.numbers(expression)
        factor, offset = float(match["factor"] or 1.0), float(match["offset"] or 0.0)
        return self.numbers(match["column"].strip()) * factor + offset

    def __getitem__(self, rows: Mask) -> Self:
        chosen = np.flatnonzero(rows).tolist()
        cells = {name: [column[i] for i in chosen] for name, column in self.cells.items()}
        return type(self)(self.path, [self.line[i] for i in chosen], cells)

    def where(self, condition: str) -> Mask:
        """Whether each row (n,) meets ``column=value``, compared as numbers where both are.

        Raises
        ------
        ConfigError
            The condition has another form, names no column, or no row meets it.
        """
        name, equals, wanted = condition.rpartition("=")
        if not equals:
            raise ConfigError(f"--select {condition!r}: is not of the form column=value")
        cells = self.column(name)
        rows = np.array([_same(cell, wanted) for cell in cells], dtype=bool)
        if not rows.any():
            has = ", ".join(sorted({str(cell) for cell in cells})[:12])
            raise ConfigError(f"--select {condition!r}: no row of {self.path} has it; {name!r} holds {has}")
        return rows


def _same(cell: Any, wanted: str) -> bool:
    try:
        return float(cell) == float(wanted)
    except (TypeError, ValueError):
        return str(cell).strip() == wanted.strip()


def read_table(path: Path) -> Table:
    """Read a CSV table with a header, or a Parquet table.

    Raises
    ------
    InputError
        The file is missing, is not a table, has two columns of one name, or a row of another width than its header.
    RoadloadError
        It is Parquet and pyarrow is not installed.
    """
    if path.suffix.lower() == ".parquet":
        return _read_parquet(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            header = [name.strip() for name in next(reader, [])]
            rows = [(reader.line_num, row) for row in reader if row]
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not a CSV table in UTF-8: {error}") from error
    if not rows:
        raise InputError(f"{path}: holds no rows; give a table with a header and at least one row")
    twice = [name for name, count in Counter(header).items() if count > 1]
    if twice:
        raise InputError(f"{path}: two columns are called {twice[0]!r}; rename one")
    for line, row in rows:
        if len(row) != len(header):
            raise InputError(f"{path}: row {line} has {len(row)} cells, the header has {len(header)}; correct the row")
    columns = zip(*(row for _, row in rows), strict=True)
    return Table(path, [line for line, _ in rows], dict(zip(header, map(list, columns), strict=True)))


def _read_parquet(path: Path) -> Table:
    try:
        from pyarrow import ArrowException, parquet
    except ImportError as error:
        raise RoadloadError(f"{path}: Parquet needs pyarrow: pip install pyarrow, or write the table as CSV") from error
    try:
        cells = parquet.read_table(path).to_pydict()
    except (OSError, ArrowException) as error:
        raise InputError(f"{path}: not a Parquet table that can be read: {' '.join(str(error).split())}") from error
    rows = len(next(iter(cells.values()), []))
    if not rows:
        raise InputError(f"{path}: holds no rows; give a table with at least one row")
    return Table(path, list(range(1, rows + 1)), cells)

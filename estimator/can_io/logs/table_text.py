"""Tables of text: a first line of names, then a line of cells a row, in CSV or with another delimiter.

A table whose delimiter is no comma may have commas in its numbers, as spreadsheets write them in much of Europe.
"""

import codecs
import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from itertools import chain, islice
from pathlib import Path

from estimator.can_io.logs.source import Source
from estimator.can_io.logs.table_piece import ROWS, Piece
from estimator.errors import LogError

MAX_FIELD = 1 << 16  # characters of a cell, and of a line: a longer one is none of a table
DELIMITERS = ",;\t|"


def read(path: Path) -> Iterator[Piece]:
    """Pieces of a table of text.

    Raises
    ------
    LogError
        It has no line of names, a line or cell that is too long, or a row with more cells than there are names.
    """
    csv.field_size_limit(MAX_FIELD)
    with Source(path) as source:
        is_wide = source.stream.peek(2)[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
        encoding = "utf-16" if is_wide else "utf-8-sig"
        text = io.TextIOWrapper(source.stream, encoding=encoding, errors="replace", newline="")
        try:
            head = text.readline(MAX_FIELD)
            delimiter = max(DELIMITERS, key=head.count)
            heading = [name.strip() for name in next(csv.reader([head], delimiter=delimiter), [])]
            _check_heading(path, heading)
            reader = _plain(path, heading, csv.reader(_lines(path, text), delimiter=delimiter), delimiter)
            while rows := [row for _, row in zip(range(ROWS), reader, strict=False)]:
                yield Piece(_columns(heading, rows), source.consumed)
        except csv.Error as error:
            raise LogError(f"{path}: is no table of text ({error}); give a CSV file") from error


def _lines(path: Path, text: io.TextIOWrapper) -> Iterator[str]:
    """The lines, none of them longer than MAX_FIELD."""
    while line := text.readline(MAX_FIELD):
        if len(line) == MAX_FIELD:
            raise LogError(f"{path}: has a line of over {MAX_FIELD} characters; give a CSV file")
        yield line


def _columns(heading: Sequence[str], rows: Sequence[Sequence[str]]) -> Mapping[str, Sequence[str]]:
    cells = [[row[i] if i < len(row) else "" for row in rows] for i in range(len(heading))]
    return dict(zip(heading, cells, strict=True))


def _plain(path: Path, heading: Sequence[str], rows: Iterator[list[str]], delimiter: str) -> Iterator[list[str]]:
    """The rows, with points for decimal commas; refuses a row with more cells than there are names.

    Where the first ROWS rows have a number with a point, commas are not taken for decimal ones.
    """
    first = list(islice(rows, ROWS))
    has_points = delimiter == "," or any("." in cell and is_number(cell) for row in first for cell in row)
    for number, row in enumerate(chain(first, rows), start=1):
        if len(row) > len(heading) and any(row[len(heading) :]):
            raise LogError(
                f"{path}: row {number} has {len(row)} cells, line 1 has {len(heading)} names; correct that row, or "
                "write numbers with decimal points"
            )
        yield row if has_points else [cell.replace(",", ".") for cell in row]


def _check_heading(path: Path, heading: list[str]) -> None:
    """Refuse a first line without names of columns."""
    if len(heading) < 2 or all(is_number(name) for name in heading):
        raise LogError(f"{path}: line 1 names no columns ({', '.join(heading)[:60]!r}); put a line of names first")


def is_number(text: str) -> bool:
    """Whether a cell is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True

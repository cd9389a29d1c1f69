"""Tables of text: a first line of names, then a line of cells a row, in CSV or with another delimiter.

A table whose delimiter is no comma may have commas in its numbers, as spreadsheets write them in much of Europe.
"""

import codecs
import csv
import io
import re
from collections import Counter
from collections.abc import Container, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain, islice
from pathlib import Path

from estimator.can_io.logs.source import Source
from estimator.can_io.logs.table_piece import ROWS, Piece, Wanted
from estimator.errors import LogError

MAX_FIELD = 1 << 16  # characters of a cell, and of a line: a longer one is none of a table
DELIMITERS = ",;\t|"
SEPARATOR = re.compile(rf"sep=([{DELIMITERS}])\s*", re.IGNORECASE)  # a line before the names, for Excel


@dataclass(frozen=True)
class Head:
    """The line of names, which has a number, and the delimiter of the table."""

    line: int
    names: list[str]
    delimiter: str


def read(path: Path, wanted: Wanted) -> Iterator[Piece]:
    """Pieces of a table of text, of the wanted columns only.

    Raises
    ------
    LogError
        It has no line of names, a line or cell that is too long, or a row with more cells than there are names; or no
        row has a cell of a wanted column.
    """
    csv.field_size_limit(MAX_FIELD)
    with Source(path) as source:
        is_wide = source.stream.peek(2)[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
        encoding = "utf-16" if is_wide else "utf-8-sig"
        text = io.TextIOWrapper(source.stream, encoding=encoding, errors="replace", newline="")
        try:
            head = _head(path, text)
            chosen = wanted(head.names)
            places = {name: i for i, name in enumerate(head.names) if name in chosen}
            reader, short = _whole_rows(path, text, head), list[int]()  # numbers of rows, from 0
            cells_of = _cells(path, head, list(places.values()), reader)
            rows = _with_points(path, _wide_enough(path, head, chosen, cells_of, short), head.delimiter)
            done = 0
            while part := list(islice(rows, ROWS)):
                cells = dict(zip(places, zip(*part, strict=True), strict=True))
                in_part = [number - done for number in short]
                yield Piece({**dict.fromkeys(head.names, ()), **cells}, source.consumed, short=in_part)
                short.clear()
                done += len(part)
        except csv.Error as error:
            raise LogError(f"{path}: is no table of text ({error}); give a CSV file") from error


def _head(path: Path, text: io.TextIOWrapper) -> Head:
    """The line of names: the first one, or the second after a line ``sep=;``. Refuses one without names of columns."""
    line, number = text.readline(MAX_FIELD), 1
    if given := SEPARATOR.fullmatch(line):
        line, number = text.readline(MAX_FIELD), 2
    delimiter = given[1] if given else max(DELIMITERS, key=line.count)
    names = [name.strip() for name in next(csv.reader([line], delimiter=delimiter), [])]
    if len(names) < 2 or all(is_number(name) for name in names):
        said = f"line {number} names no columns ({', '.join(names)[:60]!r})"
        raise LogError(f"{path}: {said}; put a line of names first")
    return Head(number, names, delimiter)


def _lines(path: Path, text: io.TextIOWrapper) -> Iterator[str]:
    """The lines, none of them longer than MAX_FIELD."""
    while line := text.readline(MAX_FIELD):
        if len(line) == MAX_FIELD:
            raise LogError(f"{path}: has a line of over {MAX_FIELD} characters; give a CSV file")
        yield line


def _whole_rows(path: Path, text: io.TextIOWrapper, head: Head) -> Iterator[list[str]]:
    """The rows after the names; refuses a quote that hides other rows, or all after it, as it is not closed."""
    reader = csv.reader(_lines(path, text), delimiter=head.delimiter)
    line = head.line
    try:
        for row in reader:
            if head.line + reader.line_num > line + 1 and any(_hides_rows(cell, head) for cell in row):
                raise csv.Error
            line = head.line + reader.line_num
            yield row
    except csv.Error as error:  # or a cell that is longer than any line
        raise LogError(f"{path}: line {line + 1} has a quote that is not closed; remove it") from error


def _hides_rows(cell: str, head: Head) -> bool:
    """Whether a line after the first one of a quoted cell has as many delimiters as the line of names."""
    return any(line.count(head.delimiter) >= len(head.names) - 1 for line in cell.splitlines()[1:])


def _cells(path: Path, head: Head, places: Sequence[int], rows: Iterator[list[str]]) -> Iterator[tuple[int, list[str]]]:
    """Width, and the cells at ``places``, of each row that is not blank; a cell that is missing is empty.

    Refuses a row with more cells than there are names.
    """
    names = len(head.names)
    for number, row in enumerate(filter(None, rows), start=1):
        if len(row) > names and any(row[names:]):
            raise LogError(
                f"{path}: row {number} has {len(row)} cells, line {head.line} has {names} names; correct that row, or "
                "write numbers with decimal points"
            )
        yield min(len(row), names), [row[i] if i < len(row) else "" for i in places]


def _wide_enough(
    path: Path, head: Head, chosen: Container[str], rows: Iterator[tuple[int, list[str]]], short: list[int]
) -> Iterator[list[str]]:
    """The cells of each row.

    Numbers, from 0, of rows with fewer cells than most are added to ``short``; all their cells are empty, as the last
    one may be cut.
    """
    first = list(islice(rows, ROWS))
    usual = _usual_width(path, head, chosen, Counter(width for width, _ in first))
    for number, (width, cells) in enumerate(chain(first, rows)):
        if width < usual:
            short.append(number)
        yield cells if width >= usual else len(cells) * [""]


def _usual_width(path: Path, head: Head, chosen: Container[str], counts: Counter[int]) -> int:
    """Number of cells that most rows have, from the ``counts`` of rows by their width.

    It is less than that of names where empty cells at the end are left out. Refused are rows that all lack a cell of a
    ``chosen`` column, and a name that a delimiter in it seems to cut.
    """
    heading = head.names
    longest = max(counts, default=len(heading))
    said = f"{path}: line {head.line} has {len(heading)} names, but no row has more than {longest} cells"
    parts = [name for name in heading if any(name.count(a) != name.count(b) for a, b in ("()", "[]"))]
    if longest < len(heading) and parts:
        raise LogError(f"{said}, and {parts[0]!r} seems to be part of a name; put the name into quotes")
    if lacking := [name for name in heading[longest:] if name in chosen]:
        raise LogError(f"{said}, so column {lacking[0]!r} is empty; fill it in, or name another column")
    return max(counts, key=lambda width: (counts[width], width), default=len(heading))


def _with_points(path: Path, rows: Iterator[list[str]], delimiter: str) -> Iterator[list[str]]:
    """The rows, with points for decimal commas: where the first ROWS rows have more of these than of points.

    A point in a number beside them, as of thousands, is refused.
    """
    first = list(islice(rows, ROWS))
    with_point, with_comma = (
        sum(sign in cell and is_number(cell.replace(sign, ".")) for row in first for cell in row) for sign in ".,"
    )
    has_points = delimiter == "," or with_point >= max(with_comma, 1)
    for number, row in enumerate(chain(first, rows), start=1):
        if not has_points and (odd := next((cell for cell in row if "." in cell and is_number(cell)), None)):
            raise LogError(f"{path}: row {number}: {odd!r} has a point beside decimal commas; write it without")
        yield row if has_points else [cell if "." in cell else cell.replace(",", ".") for cell in row]


def is_number(text: str) -> bool:
    """Whether a cell is a number; one with underscores is a number of Python alone."""
    try:
        float(text)
    except ValueError:
        return False
    return "_" not in text

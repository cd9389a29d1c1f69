"""Table of measurements as a log: CSV or Parquet, with a column of times and one for each role.

Times are seconds (or another unit in brackets), an epoch, or dates in ISO 8601, in UTC without a zone. Empty cells,
``nan`` and ``null`` have no value. Times must ascend, and be frequent enough for accelerations.
"""

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from estimator.can_io.frames import CLASSIC_BYTES, Frames
from estimator.can_io.logs.log import Log
from estimator.can_io.logs.source import Source
from estimator.can_io.table_columns import (
    FORCE_UNITS,
    NUMBER_BYTES,
    TIME_UNITS,
    Column,
    columns_of,
    ident_of,
    split_unit,
)
from estimator.errors import LogError
from estimator.extras import how_to_install
from estimator.settings import Table
from estimator.signals import Floats, Role
from estimator.units import conversion_of

SUFFIXES = (".csv", ".csv.gz", ".tsv", ".txt", ".parquet")
TIMES = ("time", "t", "timestamp", "seconds", "secs", "elapsed", "time_s", "t_s", "date", "datetime")
NOTHING = ("", "nan", "null", "none", "na", "n/a", "-")
ROWS = 1 << 14  # at once
MAX_FIELD = 1 << 16  # characters of a cell: a longer one is none of a table
MAX_STEP = 2.0  # s between rows in the median: slower ones show no change of speed that a force made
DELIMITERS = ",;\t|"


class TableLog(Log):
    """Log in a table file; ``table`` of the configuration defines its columns."""

    def __init__(self, path: Path, table: Table) -> None:
        super().__init__(path)
        self._table = table
        if not path.is_file():
            raise LogError(f"{path}: no such file; check the path")
        if not path.name.lower().endswith(SUFFIXES):
            raise LogError(f"{path}: is no table that can be read ({', '.join(SUFFIXES)}); take the table [table] out")

    def _read(self) -> Iterator[Frames]:
        pieces = self._parquet() if self.path.suffix.lower() == ".parquet" else self._text()
        for frames in table_frames(str(self.path), self._table, pieces):
            yield self.channels.keep(frames, np.zeros(len(frames), np.uint16), str)

    def _text(self) -> Iterator[Mapping[str, Sequence[str]]]:
        csv.field_size_limit(MAX_FIELD)
        with Source(self.path) as source:
            text = io.TextIOWrapper(source.stream, encoding="utf-8-sig", errors="replace", newline="")
            try:
                head = text.readline(MAX_FIELD)
                delimiter = max(DELIMITERS, key=head.count)
                heading = [name.strip() for name in next(csv.reader([head], delimiter=delimiter), [])]
                _check_heading(self.path, heading)
                reader = csv.reader(text, delimiter=delimiter)
                while rows := [row for _, row in zip(range(ROWS), reader, strict=False)]:
                    self.progress = source.consumed
                    cells = [[row[i] if i < len(row) else "" for row in rows] for i in range(len(heading))]
                    yield dict(zip(heading, cells, strict=True))
            except csv.Error as error:
                raise LogError(f"{self.path}: is no table of text ({error}); give a CSV file") from error

    def _parquet(self) -> Iterator[Mapping[str, Any]]:
        try:
            from pyarrow import ArrowException
            from pyarrow.parquet import ParquetFile
        except ImportError as error:
            raise LogError(f"{self.path}: Parquet needs pyarrow: {how_to_install('fleet')}") from error
        try:
            with ParquetFile(self.path) as file:
                names, total = file.schema_arrow.names, max(file.metadata.num_rows, 1)
                done = 0
                wanted = [name for name in names if name in _named(self._table, names)]
                for batch in file.iter_batches(ROWS, columns=wanted, use_threads=False):
                    done += batch.num_rows
                    self.progress = done / total
                    yield {name: batch.column(name).to_numpy(zero_copy_only=False) for name in wanted}
        except (ArrowException, OSError) as error:
            reason = " ".join(str(error).split())
            raise LogError(f"{self.path}: cannot be read as Parquet ({reason}); copy it anew") from error


def _check_heading(path: Path, heading: list[str]) -> None:
    """Refuse a first line without names of columns."""
    if len(heading) < 2 or all(_is_number(name) for name in heading):
        raise LogError(f"{path}: line 1 names no columns ({', '.join(heading)[:60]!r}); put a line of names first")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _named(table: Table, there: Iterable[str]) -> set[str]:
    """Columns that the configuration of a table names, and those that may hold times."""
    times = {name for name in there if name.lower() in TIMES} if table.time is None else {split_unit(table.time)[0]}
    return {column.name for column in columns_of(table)} | times


def table_frames(source: str, table: Table, pieces: Iterable[Mapping[str, Any]]) -> Iterator[Frames]:
    """Yield frames of a table from pieces of rows, each a mapping of column names to cells (n,).

    Raises
    ------
    LogError
        A column is missing, a cell is not a number, or times do not ascend or are too far apart; it names the row.
    """
    columns = columns_of(table)
    previous, row, steps = -np.inf, 1, list[Floats]()
    for piece in pieces:
        t = _times(source, table, piece, row)
        _check_forward(source, t, previous, row)
        steps.append(np.diff(t, prepend=t[:1] if not np.isfinite(previous) else previous))
        if len(t):
            previous = float(t[-1])
        yield _frames(t, _values(source, columns, piece, row))
        row += len(t)
    step = float(np.median(np.concatenate([np.empty(0), *steps]))) if row > 2 else 0.0
    if step > MAX_STEP:
        raise LogError(
            f"{source}: has a row every {step:.3g} s; the mass follows from changes of speed within a second or two, "
            f"so give rows of {MAX_STEP:.0f} s or less, or another unit of the times"
        )


def _times(source: str, table: Table, piece: Mapping[str, Any], row: int) -> Floats:
    """Times [s] (n,) of the rows."""
    name, unit = (None, None) if table.time is None else split_unit(table.time)
    if name is None:
        name = next((column for column in piece if column.lower() in TIMES), None)
    if name is None or name not in piece:
        wanted = f"column {name!r}" if name else f"column of times ({', '.join(TIMES[:4])} ...)"
        raise LogError(f'{source}: has no {wanted}; name it: --map time="COLUMN [s]"; there are {_listed(piece)}')
    factor = 1.0 if unit is None else TIME_UNITS.get(unit.lower(), np.nan)
    if not np.isfinite(factor):
        raise LogError(f"{source}: the unit {unit!r} of the times is not known; write one of {' '.join(TIME_UNITS)}")
    cells = np.asarray(piece[name])
    if cells.dtype.kind == "M":
        return cells.astype("datetime64[ns]").astype(np.int64) / 1e9
    if cells.dtype.kind in "OUS" and len(cells) and not _is_number(str(cells[0])):
        return np.array([_date(source, str(cell), row + i) for i, cell in enumerate(cells.tolist())])
    return factor * _numbers(source, name, cells, row)


def _date(source: str, text: str, row: int) -> float:
    try:
        date = datetime.fromisoformat(text.strip())
    except ValueError:
        raise LogError(f"{source}: row {row}: {text[:40]!r} is no time; write seconds, or dates as ISO 8601") from None
    return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()


def _check_forward(source: str, t: Floats, previous: float, row: int) -> None:
    """Refuse rows without a time, and rows that are not later than the previous one."""
    steps = np.diff(t, prepend=previous)
    if wrong := np.flatnonzero(~np.isfinite(t)).tolist():
        raise LogError(f"{source}: row {row + wrong[0]}: has no time; fill it in, or delete the row")
    if back := np.flatnonzero(steps < 0).tolist():
        i = back[0]
        last = t[i - 1] if i else previous
        raise LogError(
            f"{source}: row {row + i}: time steps back from {last:.10g} to {t[i]:.10g} s; sort the rows, or give each "
            "drive as a table of its own"
        )
    if same := np.flatnonzero(steps == 0).tolist():
        raise LogError(
            f"{source}: rows {row + same[0] - 1} and {row + same[0]} have one time, {t[same[0]]:.10g} s; give a column "
            "with fractions of seconds"
        )


def _values(source: str, columns: Sequence[Column], piece: Mapping[str, Any], row: int) -> Floats:
    """Values (n, k) of the columns in the units of their messages; NaN for a cell without a value."""
    for column in columns:
        if column.name not in piece:
            raise LogError(f"{source}: has no column {column.name!r}; there are {_listed(piece)}")
    values = {column.role: _numbers(source, column.name, piece[column.name], row) for column in columns}
    for column in columns:
        if column.is_force:
            speed = next(other for other in columns if other.role is Role.SPEED)
            conversion = conversion_of(speed.unit)
            assert conversion is not None  # checked with the configuration
            force = FORCE_UNITS[column.unit.lower()] * values[column.role]
            values[column.role] = force * conversion.scale * values[Role.SPEED]
    return np.column_stack([values[column.role] for column in columns])


def _numbers(source: str, name: str, cells: Any, row: int) -> Floats:
    """Convert cells (n,) to numbers."""
    given = np.asarray(cells)
    if given.dtype.kind in "fiub":
        return given.astype(np.float64)
    texts = [str(cell).strip() for cell in given.tolist()]
    try:
        return np.array([np.nan if text.lower() in NOTHING else float(text) for text in texts])
    except ValueError:
        i = next(i for i, text in enumerate(texts) if text.lower() not in NOTHING and not _is_number(text))
        raise LogError(f"{source}: row {row + i}, column {name!r}: {texts[i][:40]!r} is no number") from None


def _frames(t: Floats, values: Floats) -> Frames:
    """One frame for every value, row by row."""
    n, k = values.shape
    is_known = np.isfinite(values).ravel()
    ident = np.tile(np.array([ident_of(i) for i in range(k)], np.uint32), n)[is_known]
    data = np.ascontiguousarray(values.ravel()[is_known].reshape(-1, 1)).view(np.uint8).reshape(-1, CLASSIC_BYTES)
    return Frames(np.repeat(t, k)[is_known], ident, np.full(len(ident), NUMBER_BYTES, np.uint8), data)


def _listed(piece: Mapping[str, Any]) -> str:
    names = [repr(str(name)) for name in piece]
    return ", ".join(names[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "")

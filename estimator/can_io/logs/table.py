"""A table of measurements as a log: a row at a time, a column of times and one for each role.

Times are seconds (or another unit in brackets), an epoch, or dates in ISO 8601, in UTC without a zone. Empty cells,
``nan`` and ``null`` have no value. Times must ascend, and be frequent enough for accelerations.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.can_io.frames import CLASSIC_BYTES, Frames
from estimator.can_io.logs import table_activity, table_mf4, table_parquet, table_text
from estimator.can_io.logs.log import Log, start_of
from estimator.can_io.logs.table_piece import ROWS, Piece, Wanted
from estimator.can_io.logs.table_text import is_number
from estimator.can_io.logs.table_times import SameTimes
from estimator.can_io.table_columns import (
    FORCE_UNITS,
    NUMBER_BYTES,
    TIME,
    TIME_UNITS,
    Column,
    check_units,
    columns_of,
    factor_and_offset,
    ident_of,
    in_file,
    name_in,
    seconds_in,
    split_unit,
    texts_of,
)
from estimator.can_io.time_order import MAX_TIME, finer_unit
from estimator.errors import LogError
from estimator.settings import Table
from estimator.signals import DIMENSION, STATE, Floats, Role
from estimator.units import conversion_of

Reader = Callable[[Path, Wanted], Iterator[Piece]]
READERS: dict[str, Reader] = {
    ".csv": table_text.read,
    ".csv.gz": table_text.read,
    ".tsv": table_text.read,
    ".txt": table_text.read,
    ".parquet": table_parquet.read,
    ".mf4": table_mf4.read,
    ".fit": table_activity.read_fit,
    ".fit.gz": table_activity.read_fit,
    ".tcx": table_activity.read_tcx,
    ".tcx.gz": table_activity.read_tcx,
}
SUFFIXES = tuple(READERS)
TIMES = ("time", "t", "timestamp", "seconds", "secs", "elapsed", "time_s", "t_s", "date", "datetime")
NOTHING = dict.fromkeys(("", "nan", "null", "none", "na", "n/a", "-"), float("nan"))
STATES = {**NOTHING, "true": 1.0, "false": 0.0, "on": 1.0, "off": 0.0}
MAX_STEP = 2.0  # s between rows in the median: slower ones show no change of speed that a force made
MIN_STEP = 0.009  # s: tables have up to 100 rows a second, so seconds that would be less are no finer unit
SAME_TIME = "row with a second value at its time"
SHORT = "row with fewer cells than names"


class TableLog(Log):
    """Log in a table file; ``table`` of the configuration defines its columns."""

    content = "row with a number"

    def __init__(self, path: Path, table: Table) -> None:
        super().__init__(path)
        self._table = table
        start_of(path, 1)
        if not path.name.lower().endswith(SUFFIXES):
            raise LogError(
                f"{path}: is no table that can be read ({', '.join(SUFFIXES)}); export it as one of them, or, for a "
                "log, take out --map, or [table] of the configuration"
            )

    def _read(self) -> Iterator[Frames]:
        for frames in table_frames(str(self.path), self._table, self._pieces(), self.skipped):
            yield self.channels.keep(frames, np.zeros(len(frames), np.uint16), str)

    def _pieces(self) -> Iterator[Piece]:
        name = self.path.name.lower()
        read = next(reader for suffix, reader in READERS.items() if name.endswith(suffix))
        for piece in read(self.path, partial(_named, self.path, self._table)):
            self.progress = piece.progress
            yield piece


def _named(path: Path, table: Table, there: Iterable[str]) -> set[str]:
    """Columns that the configuration of a table names, and those that may hold times.

    Raises
    ------
    LogError
        Two columns have one of these names.
    """
    columns = list(there)
    table = in_file(str(path), table, columns)
    given = [column.text for column in columns_of(table)] + ([] if table.time is None else [table.time])
    named = {name_in(columns, text) for text in given}
    if table.time is None:
        named |= {name for name in columns if name.lower() in TIMES}
    for name in sorted(named & set(columns)):
        if columns.count(name) > 1:
            raise LogError(f"{path}: has the column {name!r} {columns.count(name)} times; rename or leave out one")
    return named


def table_frames(
    source: str, table: Table, pieces: Iterable[Piece], skipped: Counter[str] | None = None
) -> Iterator[Frames]:
    """Yield frames of a table from pieces of rows.

    Rows of one time are one row. A cell whose column has a value at its time, as of a row that two laps share, is left
    out, and so is a row with fewer cells than names. Both rows are counted in ``skipped``.

    Raises
    ------
    LogError
        A column is missing or in another unit, a cell is not a number, or times do not ascend or are too far apart; it
        names the row.
    """
    columns = columns_of(table)
    previous, row, rows, name = -np.inf, 1, SameTimes(len(columns)), ""
    steps, held, is_judged = list[Floats](), list[Frames](), False
    for piece in pieces:
        here = in_file(source, table, piece.cells)
        check_units(source, here, piece.cells, piece.units)
        name, unit, cells = _time_cells(source, table, here, piece.cells)
        t, values = _times(source, name, unit, cells, row), _values(source, table, here, piece.cells, row)
        whole = np.delete(np.arange(len(t)), piece.short)
        numbers, row = row + whole, row + len(t)
        t, values = t[whole], values[whole]
        later = _steps(source, t, previous, numbers)
        previous = float(t[-1]) if len(t) else previous
        if skipped is not None and piece.short:
            skipped[SHORT] += len(piece.short)
        held.append(_frames(columns, *rows.feed(t, values)))
        if not is_judged:
            steps.append(later)
            is_judged = row > ROWS
            if is_judged:
                _check_rate(source, name, steps, previous)  # before hours of rows are processed in vain
        if is_judged:
            yield from held
            held.clear()
    if skipped is not None and rows.refused:
        skipped[SAME_TIME] += rows.refused
    if rows.refused >= max(rows.times, 1):
        raise LogError(
            f"{source}: rows {rows.first - 1} and {rows.first} have one time, and so have half of the rows; give a "
            "column with fractions of seconds"
        )
    if not is_judged:
        _check_rate(source, name, steps, previous)
    yield from held
    yield _frames(columns, *rows.finish())


def _check_rate(source: str, name: str, steps: Sequence[Floats], latest: float) -> None:
    """Refuse rows whose steps of time [s] are too long in the median, or whose ``latest`` time is none."""
    step = float(np.median(np.concatenate([[0.0], *steps])))
    if step <= MAX_STEP and latest <= MAX_TIME:
        return
    wrong = f"has a row every {step:.3g} s" if step > MAX_STEP else f"has times up to {latest:.3g} s"
    unit = finer_unit(step, MAX_STEP, latest, MIN_STEP if latest <= MAX_TIME else 0.0)
    finer = f'; if its times are {unit}, say so: --map time="{split_unit(name)[0]} [{unit}]"' if unit else ""
    raise LogError(
        f"{source}: {wrong}; the mass follows from changes of speed within a second or two, so give rows of "
        f"{MAX_STEP:.0f} s or less{finer}"
    )


def _time_cells(
    source: str, table: Table, here: Table, piece: Mapping[str, Any]
) -> tuple[str, str | None, NDArray[Any]]:
    """Name, unit and cells (n,) of the times; a column of dates and one of times of day are joined."""
    guesses = sorted((column for column in piece if column.lower() in TIMES), key=str.lower)
    if here.time is not None:
        name, unit = name_in(piece, here.time), split_unit(here.time)[1]
    elif len(guesses) > 1:
        parts = [np.asarray(piece[column]).astype(str).tolist() for column in guesses]
        if [column.lower() for column in guesses] != ["date", "time"] or all(map(is_number, parts[1])):
            names = " and ".join(map(repr, guesses))
            raise LogError(f'{source}: {names} may each be the times; name one of them: --map time="COLUMN [s]"')
        return guesses[1], None, np.array([" ".join(cells) for cells in zip(*parts, strict=True)])
    else:
        name, unit = next(iter(guesses), ""), None
    if not name:
        wanted = f"column of times ({', '.join(TIMES[:4])} ...)"
        raise LogError(f'{source}: has no {wanted}; name it: --map time="COLUMN [s]"; there are {_listed(piece)}')
    if name not in piece:
        raise _lacking(source, table, TIME, piece)
    return name, unit, np.asarray(piece[name])


def _times(source: str, name: str, unit: str | None, cells: NDArray[Any], row: int) -> Floats:
    """Times [s] (n,) of the rows."""
    factor = 1.0 if unit is None else seconds_in(unit)
    if factor is None:
        raise LogError(f"{source}: the unit {unit!r} of the times is not known; write one of {' '.join(TIME_UNITS)}")
    if cells.dtype.kind in "mM":
        return np.where(np.isnat(cells), np.nan, cells.astype(f"{cells.dtype.kind}8[ns]").astype(np.int64) / 1e9)
    texts = (str(cell).strip() for cell in cells.tolist()) if cells.dtype.kind in "OUS" else ()
    if not is_number(next((text for text in texts if text.lower() not in NOTHING), "0")):
        return np.array([_date(source, str(cell), row + i) for i, cell in enumerate(cells.tolist())])
    return factor * _numbers(source, name, cells, row)


def _date(source: str, text: str, row: int) -> float:
    if text.strip().lower() in NOTHING:
        return float("nan")
    try:
        date = datetime.fromisoformat(text.strip())
    except ValueError:
        raise LogError(f"{source}: row {row}: {text[:40]!r} is no time; write seconds, or dates as ISO 8601") from None
    return (date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp()


def _steps(source: str, t: Floats, previous: float, numbers: NDArray[np.intp]) -> Floats:
    """Steps [s] between the times of rows; refuses rows without a time, and those that are earlier than one before.

    The rows have ``numbers`` (n,).
    """
    steps = np.diff(t, prepend=previous)
    if wrong := np.flatnonzero(~np.isfinite(t)).tolist():
        raise LogError(f"{source}: row {numbers[wrong[0]]}: has no time; fill it in, or delete the row")
    if back := np.flatnonzero(steps < 0).tolist():
        i = back[0]
        last = t[i - 1] if i else previous
        raise LogError(
            f"{source}: row {numbers[i]}: time steps back from {last:.10g} to {t[i]:.10g} s; sort the rows, or "
            "give each drive as a table of its own"
        )
    return steps[(steps > 0) & np.isfinite(steps)]


def _values(source: str, table: Table, here: Table, piece: Mapping[str, Any], row: int) -> Floats:
    """Values (n, k) in the units of the table's columns; NaN for a cell without a value.

    Columns ``here`` in the file may be alternatives of them, in another unit.
    """
    values = list[Floats]()
    for key, first, given in zip(table.columns, columns_of(table), columns_of(here), strict=True):
        name = name_in(piece, given.text)
        if name not in piece:
            raise _lacking(source, table, key, piece)
        known = STATES if DIMENSION[given.role] == STATE else NOTHING
        factor, offset = factor_and_offset(given, first)
        values.append(factor * _numbers(source, name, piece[name], row, known) + offset)
    return np.column_stack(values)


def _lacking(source: str, table: Table, key: str, piece: Mapping[str, Any]) -> LogError:
    """Error of a table without the column of a role, or of the time, and its alternatives."""
    names = " or ".join(repr(name_in(piece, text)) for text in texts_of(table, key))
    remedy = f"where files name it differently, repeat --map {key}= with each name"
    return LogError(f"{source}: has no column {names}; there are {_listed(piece)}; {remedy}")


def _numbers(source: str, name: str, cells: Any, row: int, known: Mapping[str, float] = NOTHING) -> Floats:
    """Convert cells (n,) to numbers; ``known`` are the texts that are numbers, or none."""
    given = np.asarray(cells)
    if given.ndim > 1:
        raise LogError(f"{source}: column {name!r} holds {given.shape[1]} values a row; give one column for each")
    if given.dtype.kind in "fiub":
        return given.astype(np.float64)
    texts = [str(cell).strip() for cell in given.tolist()]
    try:
        if "_" in "".join(texts):  # which only Python has in numbers
            raise ValueError
        return np.array([known[low] if (low := text.lower()) in known else float(text) for text in texts])
    except ValueError:
        i = next(i for i, text in enumerate(texts) if text.lower() not in known and not is_number(text))
        cell = f"row {row + i}, column {name!r}: {texts[i][:40]!r}"
        raise LogError(f"{source}: {cell} is no number; correct it, or leave the cell empty") from None


def _frames(columns: Sequence[Column], t: Floats, values: Floats) -> Frames:
    """One frame for every value of rows (n, k), row by row; that of a force is its power [W]."""
    n, k = values.shape
    roles = [column.role for column in columns]
    for i, column in enumerate(columns):
        if column.is_force:
            speed = roles.index(Role.SPEED)
            conversion = conversion_of(columns[speed].unit)
            assert conversion is not None  # checked with the configuration
            with np.errstate(invalid="ignore"):  # an infinite force at rest
                values[:, i] = FORCE_UNITS[column.unit.lower()] * values[:, i] * conversion.scale * values[:, speed]
    is_known = ~np.isnan(values).ravel()  # an infinite one is refused, and counted, as it is decoded
    ident = np.tile(np.array([ident_of(i) for i in range(k)], np.uint32), n)[is_known]
    data = np.ascontiguousarray(values.ravel()[is_known].reshape(-1, 1)).view(np.uint8).reshape(-1, CLASSIC_BYTES)
    return Frames(np.repeat(t, k)[is_known], ident, np.full(len(ident), NUMBER_BYTES, np.uint8), data)


def _listed(piece: Mapping[str, Any]) -> str:
    names = [repr(str(name)) for name in piece]
    return ", ".join(names[:12]) + (f" and {len(names) - 12} more" if len(names) > 12 else "")

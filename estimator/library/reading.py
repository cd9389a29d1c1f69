"""Drives from logs, from tables in files, and from tables in memory."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.can_io.logs.table import table_frames
from estimator.can_io.logs.table_piece import ROWS, Piece
from estimator.config import Config, replace
from estimator.errors import InputError
from estimator.preparation.drive import Drive
from estimator.settings import Table
from estimator.streaming.drive_extraction import drives_of, rows_of
from estimator.streaming.row_stream import RowStream


def read(path: str | Path, config: Config | None = None, columns: Mapping[str, str] | None = None) -> Drive:
    """The drive in a log, or in a table (CSV, Parquet).

    Parameters
    ----------
    path
        The file.
    config
        Settings and binding, as `load_config` reads them; None: a plain J1939 log.
    columns
        Of a table: ``{"speed": "v [km/h]", "power": "P [kW]", "time": "t [s]"}``.

    Raises
    ------
    LogError
        The file cannot be read.
    MissingInputsError
        It lacks inputs of the model.
    InputError
        It holds no drive, or several; `read_drives` gives them.
    """
    drives = read_drives(path, config, columns)
    if len(drives) != 1:
        count = f"{len(drives)} drives" if drives else "no drive"
        raise InputError(f"{path}: holds {count}; read_drives gives a list of them")
    return drives[0]


def read_drives(
    path: str | Path, config: Config | None = None, columns: Mapping[str, str] | None = None
) -> list[Drive]:
    """All drives in a log or a table, in order of time; see `read`."""
    settings = config or Config()
    return drives_of(Path(path), settings if columns is None else _with_table(settings, columns))


def from_table(
    data: Any,
    *,
    time: str | None = None,
    units: Mapping[str, str] | None = None,
    config: Config | None = None,
    **roles: str,
) -> Drive:
    """A drive from columns in memory: a data frame of pandas or polars, or a mapping of names to arrays (n,).

    Parameters
    ----------
    data
        The columns, 1 to 100 rows a second; values that are not known are NaN. Gaps are allowed.
    time
        Column of times, with its unit: ``"t [s]"``; None: the one that is called ``time``, ``t``, ``timestamp`` ...
    units
        Units by column, for columns without one in brackets.
    config
        Settings; its binding is not used.
    **roles
        Columns by role, as ``speed="v [km/h]"`` and ``power="P [kW]"``, or ``engine_torque`` and ``engine_speed``, or
        ``battery_voltage`` and ``battery_current``, or ``force`` at the wheels; ``altitude``, ``grade``,
        ``brake_switch`` ... where they are known.

    Raises
    ------
    ConfigError
        A role is not known, or a unit is missing or does not fit.
    LogError
        A column is missing, a cell is no number, or times do not go forward.
    MissingInputsError
        Speed or power is missing.
    """
    given = dict(units or {})
    columns = {role: _with_unit(column, given) for role, column in roles.items()}
    if time is not None:
        columns["time"] = _with_unit(time, given)
    settings = _with_table(config or Config(), columns)
    assert settings.table is not None
    stream = RowStream(settings)
    pieces = rows_of(table_frames("table", settings.table, _pieces(data)), stream, "table")
    if len(pieces) != 1:
        raise InputError(f"table: holds {len(pieces)} drives, pauses of over 15 min between them; give each by itself")
    return Drive.of(pieces[0], settings)


def _with_table(config: Config, columns: Mapping[str, str]) -> Config:
    others = {role: column for role, column in columns.items() if role != "time"}
    return replace(config, table=Table(time=columns.get("time"), columns=others))


def _with_unit(column: str, units: Mapping[str, str]) -> str:
    return f"{column} [{units[column]}]" if column in units else column


def _pieces(data: Any) -> Iterable[Piece]:
    """Rows of columns in memory, ROWS at a time."""
    names = [str(name) for name in (data.keys() if isinstance(data, Mapping) else data.columns)]
    columns = {name: _array(data[name]) for name in names}
    lengths = {name: len(column) for name, column in columns.items()}
    if len(set(lengths.values())) > 1:
        raise InputError(f"table: columns have different lengths: {lengths}")
    for first in range(0, max(lengths.values(), default=0), ROWS):
        yield Piece({name: column[first : first + ROWS] for name, column in columns.items()}, 1.0)


def _array(column: Any) -> NDArray[Any]:
    """Cells (n,) of a column; those that are masked are NaN."""
    if isinstance(column, np.ma.MaskedArray) and column.dtype.kind in "fiub":
        return np.ma.filled(column.astype(np.float64), np.nan)
    return np.asarray(column)


def as_drives(drives: Drive | Sequence[Drive]) -> list[Drive]:
    """One drive, or several, as a list.

    Raises
    ------
    InputError
        Something else is given: a path, or columns.
    """
    several = [drives] if isinstance(drives, Drive) else drives
    if isinstance(several, str | Mapping) or not all(isinstance(drive, Drive) for drive in several):
        raise InputError(
            f"drives: is {type(drives).__name__}; give read(path), from_table(data, ...) or a list of these"
        )
    return list(several)

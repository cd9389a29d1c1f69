"""Columns of the tables of a fleet, and the tables as files: Parquet with units in the schema, and CSV."""

import csv
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from datetime import UTC, datetime
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from estimator.columns import EVIDENCE, Column, Row, posterior
from estimator.errors import RoadloadError
from estimator.extras import how_to_install
from estimator.output_files import whole
from estimator.printable import escaped
from estimator.units import STANDARD_DENSITY

CSV = ".csv"  # suffix of a table for a spreadsheet, beside the Parquet file
UNUSED = ("unreadable", "duplicate", "failed")  # status of a log that gives no estimate, with its reason


def _change(name: str, unit: str, meaning: str) -> list[Column]:
    return [Column(f"{name}_{part}", "number", unit, f"{meaning}: {part}") for part in ("mean", "sd")]


DENSITY = Column("air_density_kg_m3", "number", "kg/m3", f"measured; without, c_d_A_m2 is by {STANDARD_DENSITY} kg/m3")
DRIVES = (
    Column("source", "text", meaning="first file of the drive"),
    Column("files", "count", meaning="files of the drive"),
    Column("vehicle", "text"),
    Column("segment", "count", meaning="number of the load within the drive"),
    Column("start", "time", "UTC", "first row"),
    Column("minutes", "number", "min"),
    Column("status", "text"),
    Column("reason", "text"),
    Column("note", "text", meaning="doubts about the clock or the channels"),
    *posterior("mass_kg", "kg", "mass, by the drive"),
    *posterior("A_N", "N", "rolling and friction force, by the drive"),
    *posterior("C_N_s2_m2", "N s2/m2", "aerodynamic coefficient, by the drive"),
    Column("A_reason", "text", meaning="why A is not estimated"),
    Column("C_reason", "text", meaning="why C is not estimated"),
    *posterior("c_rr", "1", "A / (m g), m with rotating parts, by the drive"),
    *posterior("c_d_A_m2", "m2", "2 C / density of the air, by the drive"),
    DENSITY,
    *posterior("joint_mass_kg", "kg", "mass, given all drives of the vehicle"),
    Column("verdict", "text", meaning="of the diagnosis"),
)
VEHICLES = (
    Column("vehicle", "text"),
    Column("drives", "count"),
    Column("loads", "count", meaning="with an estimated mass"),
    Column("minutes", "number", "min"),
    Column("start", "time", "UTC", "first row of the first drive"),
    Column("end", "time", "UTC", "last row of the last drive"),
    Column("status", "text"),
    *posterior("A_per_mass_N_kg", "N/kg", "rolling coefficient A/m at the newest drive"),
    *_change("A_per_mass_trend_N_kg", "N/kg/year", "change of A/m a year"),
    *_change("A_per_mass_winter_N_kg", "N/kg", "A/m in January above that in July"),
    Column("A_per_mass_reason", "text", meaning="why A/m is not estimated"),
    Column("A_per_mass_scatter_N_kg", "number", "N/kg", "sd of A/m between drives"),
    Column("A_per_mass_q_value", "number", "1", "false-discovery rate at which A/m is out of line"),
    *posterior("C_N_s2_m2", "N s2/m2", "aerodynamic coefficient at the newest drive"),
    *_change("C_trend_N_s2_m2", "N s2/m2/year", "change of C a year"),
    *_change("C_winter_N_s2_m2", "N s2/m2", "C in January above that in July"),
    Column("C_reason", "text", meaning="why C is not estimated"),
    Column("C_scatter_N_s2_m2", "number", "N s2/m2", "sd of C between drives"),
    Column("C_q_value", "number", "1", "false-discovery rate at which C is out of line"),
    *posterior("c_rr", "1", "A / (m g), m with rotating parts, at the newest drive"),
    *posterior("c_d_A_m2", "m2", "2 C / density of the air, at the newest drive"),
    DENSITY,
    Column("mass_kg_mean", "number", "kg", "mean of the loads"),
    Column("mass_kg_sd", "number", "kg", "sd of the loads"),
    Column("outlier", "text", meaning="parameters that are out of line, and their direction"),
)
SEASONS = (
    Column("vehicle", "text"),
    Column("season", "text", meaning="months, of any year, by UTC"),
    Column("loads", "count", meaning="with an estimated mass, and a clock that was set"),
    *posterior("A_per_mass_N_kg", "N/kg", "rolling coefficient A/m"),
    *posterior("C_N_s2_m2", "N s2/m2", "aerodynamic coefficient"),
)
EFFECTS = (
    Column("source", "text", meaning="first file of the drive"),
    Column("vehicle", "text"),
    Column("effect", "text"),
    *EVIDENCE,
)
ROAD = (
    Column("latitude", "number", "deg", "centre of the cell of the ground"),
    Column("longitude", "number", "deg", "centre of the cell of the ground"),
    Column("course", "number", "deg", "direction of travel, clockwise from north, the middle of an eighth of a turn"),
    Column("slope_mean", "number", "1", "rise over run in the direction of travel"),
    Column("slope_sd", "number", "1", "of the mean, common errors of all passes included"),
    Column("slope_scatter", "number", "1", "sd of the passes about the mean; missing for one pass"),
    Column("passes", "count"),
    Column("vehicles", "count"),
)


def doubts(drives: Sequence[Row], vehicles: Sequence[Row]) -> list[str]:
    """Lines on doubts about used drives, and on vehicles whose drives are not pooled, from the rows of the tables."""
    noted = [row for row in drives if row.get("note") and not row.get("segment")]
    apart = [row for row in vehicles if "overlap" in row["C_reason"]]
    return [f"{row['source']}: {row['note']}" for row in noted] + [
        f"{row['vehicle']}: {row['C_reason']}" for row in apart
    ]


def write_tables(
    tables: Mapping[Path, tuple[Sequence[Column], Sequence[Row]]], others: Mapping[Path, str | bytes]
) -> list[Path]:
    """Write Parquet files, each with a CSV file beside it, and other files, texts or bytes: all of them, or none.

    Returns the names of all files.

    Raises
    ------
    RoadloadError
        A file cannot be written, or pyarrow is not installed.
    """
    contents = {path: _parquet(schema, rows) for path, (schema, rows) in tables.items()}
    contents |= {path.with_suffix(CSV): _csv(schema, rows) for path, (schema, rows) in tables.items()}
    contents |= {
        path: text.encode("utf-8", "replace") if isinstance(text, str) else text for path, text in others.items()
    }
    for path in contents:
        if path.is_dir():  # no file replaces it, and others would have been replaced by then
            raise RoadloadError(f"{path}: is a folder; move it away and run again")
    with ExitStack() as stack:
        for path, content in contents.items():
            file = stack.enter_context(whole(path))
            file.write(content)
            file.flush()  # a full disk is noticed before one of them is replaced
    return list(contents)


def require_arrow() -> Any:
    """Import the modules of pyarrow that write a table.

    Raises
    ------
    RoadloadError
        pyarrow is not installed.
    """
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError as error:
        raise RoadloadError(f"roadload fleet needs pyarrow: {how_to_install('fleet')}") from error
    return pyarrow


def _parquet(schema: Sequence[Column], rows: Sequence[Row]) -> bytes:
    arrow = require_arrow()
    types = {
        "text": arrow.string(),
        "number": arrow.float64(),
        "count": arrow.int64(),
        "time": arrow.timestamp("us", tz="UTC"),
    }
    fields = []
    for column in schema:
        metadata = {"unit": column.unit, "meaning": column.meaning}
        fields.append(arrow.field(column.name, types[column.kind], metadata={k: v for k, v in metadata.items() if v}))
    arrays = [arrow.array([_cell(column, row) for row in rows], types[column.kind]) for column in schema]
    sink = arrow.BufferOutputStream()
    arrow.parquet.write_table(arrow.Table.from_arrays(arrays, schema=arrow.schema(fields)), sink)
    content: bytes = sink.getvalue().to_pybytes()
    return content


def _csv(schema: Sequence[Column], rows: Sequence[Row]) -> bytes:
    """The table as CSV in UTF-8: a line of names, then a line a row; times are in UTC, to the second."""
    text = StringIO(newline="")
    table = csv.writer(text)
    table.writerow([column.name for column in schema])
    for row in rows:
        cells = [_cell(column, row) for column in schema]
        table.writerow([f"{cell:%Y-%m-%d %H:%M:%S}" if isinstance(cell, datetime) else cell for cell in cells])
    return text.getvalue().encode()


def _cell(column: Column, row: Row) -> Any:
    """Convert a value for a file; None if it is missing."""
    value = row.get(column.name)
    if value is None or (column.kind == "number" and not np.isfinite(value)):
        return None
    if column.kind == "text":
        return escaped(value)
    return datetime.fromtimestamp(value, UTC) if column.kind == "time" else value

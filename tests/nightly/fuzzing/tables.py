"""Tables that the program reads: small sound ones of each format, and how each is read."""

import io
import struct
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Literal

import asammdf
import numpy as np
import pyarrow
import pyarrow.parquet
from made_rides import Rows, checksum, fit, tcx

from estimator.can_io.logs.table import TableLog
from estimator.errors import RoadloadError
from estimator.settings import Table

RIDE: Rows = [(float(t), 5.0 + 0.1 * t, 200.0 + t, 100.0 + 0.2 * t) for t in range(12)]
COLUMNS = {"speed": "v [km/h]", "power": "P [kW]", "altitude": "h [m]"}
OF_FIT = {"speed": "enhanced_speed [m/s]", "power": "power [W]", "altitude": "enhanced_altitude [m]"}
OF_TCX = {"speed": "Speed [m/s]", "power": "Watts [W]", "altitude": "AltitudeMeters [m]"}
CRC = struct.Struct("<H")


def read_table(path: Path, columns: Mapping[str, str] = COLUMNS) -> None:
    """Read all rows of a table."""
    for frames in TableLog(path, Table(columns=dict(columns))):
        assert len(frames)
        assert np.isfinite(frames.t).all()


def read_fit(path: Path) -> None:
    """Read a FIT file; where it is refused, with the length and the checksum that a forger gives it."""
    with suppress(RoadloadError):
        return read_table(path, OF_FIT)
    body = path.read_bytes()[14:-2]
    head = struct.pack("<BBHI4sH", 14, 0x10, 2132, len(body), b".FIT", 0)  # 0: no checksum of the header
    path.write_bytes(head + body + CRC.pack(checksum(head + body)))
    read_table(path, OF_FIT)


def read_tcx(path: Path) -> None:
    """Read a TCX file."""
    read_table(path, OF_TCX)


def fits() -> list[bytes]:
    """Sound FIT files: one of records, and one of two rides."""
    return [fit(RIDE), fit(RIDE[:6]) + fit(RIDE[6:])]


def tcxs() -> list[bytes]:
    """Sound TCX files, in UTF-8 and UTF-16."""
    text = tcx(RIDE)
    return [text.encode(), text.replace("UTF-8", "UTF-16", 1).encode("utf-16")]


def csvs() -> list[bytes]:
    """Sound tables of text."""
    rows = _rows()
    lines = [list(rows), *map(list, zip(*(column.tolist() for column in rows.values()), strict=True))]
    quoted = [[f'"{cell}"' for cell in line] for line in lines]
    texts = [
        "".join(mark.join(map(str, line)) + "\n" for line in part)
        for mark, part in ((",", lines), (";", quoted), ("\t", lines))
    ]
    dates = "".join(f"2026-05-04T06:00:{t:02d}Z,{9 + t},{t},\n" for t in range(12))
    return [text.encode() for text in (*texts, f"time,v,P,h\n{dates}")]


def parquets() -> list[bytes]:
    """Sound Parquet files, packed and plain, and one of dates and texts."""
    rows = _rows()
    dates = np.datetime64("2026-05-04T06:00:00") + (1000 * rows["t"]).astype("timedelta64[ms]")
    texts = {**rows, "t": dates, "v": [str(value) for value in rows["v"]]}
    return [_parquet(rows, "zstd"), _parquet(rows, "none"), _parquet(texts, "snappy")]


def measurements() -> list[bytes]:
    """Sound MF4 files of signals: plain and deflated, one group and three."""
    return [_measurement(1, 0), _measurement(3, 2)]


def _rows() -> dict[str, np.ndarray]:
    t = 0.1 * np.arange(12)
    return {"t": t, "v": 36.0 + t, "P": 50.0 + t, "h": 100.0 + t}


def _parquet(columns: Mapping[str, object], packing: str) -> bytes:
    file = io.BytesIO()
    pyarrow.parquet.write_table(pyarrow.table(columns), file, compression=packing, use_dictionary=packing != "none")
    return file.getvalue()


def _measurement(groups: int, compression: Literal[0, 2]) -> bytes:
    rows = _rows()
    units = {"v": "km/h", "P": "kW", "h": "m"}
    signals = [asammdf.Signal(rows[name], rows["t"], name=name, unit=unit) for name, unit in units.items()]
    with tempfile.TemporaryDirectory() as folder, asammdf.MDF(version="4.10") as file:
        for group in [signals] if groups == 1 else [[signal] for signal in signals]:
            file.append(group)
        return Path(file.save(Path(folder) / "a.mf4", compression=compression)).read_bytes()

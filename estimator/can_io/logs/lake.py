"""Log of one day of one vehicle in a lake of decoded signals.

A lake is a tree of Parquet files, ``DEVICE/CAN1_EEC1_S00/2024/01/15/00000003_00000001.parquet``: device; bus and
message with the address of its sender; year, month and day; and any file name. Source: the MF4 decoders of CSS
Electronics, which also write the multiplexers of the message, ``_MODE_M01``, and its destination, ``_DFF``, into the
name. A file has a column of times and one for each signal, in the units of the DBC that decoded it. All files of one
day are one log, named ``DEVICE/*/2024/01/15/*.parquet``. They are read in parallel, some thousand rows at a time.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePath
from tempfile import TemporaryFile, gettempdir
from typing import Any

import numpy as np

from estimator.can_io.binding import BoundMessage
from estimator.can_io.frames import CLASSIC_BYTES, EXTENDED, FD_BYTES, Frames
from estimator.can_io.logs.log import Log
from estimator.can_io.table_columns import NUMBER_BYTES
from estimator.errors import LogError
from estimator.extras import how_to_install
from estimator.signals import Floats

SUFFIX = ".parquet"
ANY = "*"  # stands for the folders of all messages in the name of a day
DAY = re.compile(r"(?P<device>.*/|)(?P<message>[A-Z]+\d+_[^/]+)/(?P<day>\d{4}/\d{2}/\d{2})/[^/]+\.parquet", re.DOTALL)
TIMES = ("t", "TimeStamp", "timestamp", "time")  # names of the column of times, which may be an index of pandas
ROWS = 1 << 12  # of one file that are read at once: four times as many took 40 MiB more
LARGE = 1 << 20  # bytes of a group of rows
BUFFER = 1 << 16  # bytes of a column that are read at once, and not all that a file has
PER_SECOND = {"s": 1e0, "ms": 1e3, "us": 1e6, "ns": 1e9}  # units of Arrow's dates

Rows = tuple[Floats, Floats]  # times (n,) [s] and values (n, k) of signals, NaN where there is none


def day_of(path: str) -> str | None:
    """Name, as a log, of the day to which a file of a lake belongs; None if it is not in a lake."""
    match = DAY.fullmatch(path)
    return None if match is None else f"{match['device']}{ANY}/{match['day']}/{ANY}{SUFFIX}"


def is_day(path: PurePath) -> bool:
    """True if a path names a day of a lake."""
    return path.name == ANY + SUFFIX and len(path.parts) >= 5 and path.parts[-5] == ANY


def files_of(day: Path) -> list[Path]:
    """Files of a day, in order of their names."""
    return sorted(day.parents[4].glob("/".join(day.parts[-5:])))


@dataclass(frozen=True)
class _Stream:
    """Files of one message, bus and sender, in order."""

    files: list[Path]
    message: BoundMessage
    bus: str
    source: int

    @property
    def ident(self) -> int:
        return EXTENDED | self.message.key << 8 | self.source


class LakeLog(Log):
    """Log of a day of a lake; ``messages`` are those of `bound_messages`."""

    batch = 1 << 14  # frames, of 64 bytes

    def __init__(self, path: Path, channels: Iterable[str], messages: Sequence[BoundMessage]) -> None:
        super().__init__(path, channels)
        self._messages = messages
        self._files = files_of(path)
        if not self._files:
            raise LogError(f"{path}: no such files; check the path")

    def _read(self) -> Iterator[Frames]:
        streams = self._streams()
        buses = sorted({stream.bus for stream in streams})
        width = max((len(_names(stream.message)) for stream in streams), default=1) * NUMBER_BYTES
        width = CLASSIC_BYTES if width <= CLASSIC_BYTES else FD_BYTES
        parts = [_frames(stream, width) for stream in streams]
        for frames, of in _side_by_side(parts):
            channel = np.array([buses.index(stream.bus) for stream in streams], np.uint16)[of]
            yield self.channels.keep(frames, channel, buses.__getitem__)

    def _streams(self) -> list[_Stream]:
        streams: dict[tuple[str, str], _Stream] = {}
        for file in self._files:
            folder = file.parents[3].name
            for message in self._messages:
                if (match := _match(folder, message.name)) is None:
                    continue
                source = int(match["source"] or "0", 16)
                stream = streams.setdefault((folder, message.name), _Stream([], message, match["bus"], source))
                stream.files.append(file)
        if not streams:
            there = ", ".join(sorted({file.parents[3].name for file in self._files})[:8])
            wanted = ", ".join(message.name for message in self._messages)
            raise LogError(f"{self.path}: no message that a role is bound to ({wanted}); the first there are {there}")
        return list(streams.values())


def _match(folder: str, message: str) -> re.Match[str] | None:
    """Bus and sender in the name of a folder of the message; None for another folder."""
    bus, parts = r"(?P<bus>[A-Z]+\d+)_", r"(?:_.+_M[0-9A-F]+)?(?:_S(?P<source>[0-9A-F]{2}))?(?:_D[0-9A-F]{2})?"
    return re.fullmatch(bus + re.escape(message) + parts, folder)


def _names(message: BoundMessage) -> list[str]:
    """Names of the signals of a message, in the order of their places."""
    places = {bound.signal.start: bound.signal.name for bound in message.signals}
    return [places[start] for start in sorted(places)]


def _frames(stream: _Stream, width: int) -> Iterator[Frames]:
    """Yield the rows of a stream as batches of frames, each in order of time."""
    names = _names(stream.message)
    for file in stream.files:
        for t, values in _pieces(file, names):
            order = np.argsort(t, kind="stable")
            data = np.zeros((len(t), width), np.uint8)
            data[:, : values.shape[1] * NUMBER_BYTES] = values[order].view(np.uint8)
            yield Frames(
                t[order],
                np.full(len(t), stream.ident, np.uint32),
                np.full(len(t), values.shape[1] * NUMBER_BYTES, np.uint8),
                data,
            )


def _pieces(file: Path, names: list[str]) -> Iterator[Rows]:
    """Yield the rows of a file, ROWS at a time.

    Arrow holds the times of a whole row group of each open file, 8 MiB for 10^6 rows, and all files of a day are open
    together. A file with large groups is therefore first unpacked to a temporary file.
    """
    with _opened(file) as table:
        sizes = [table.metadata.row_group(i).total_byte_size for i in range(table.num_row_groups)]
    rows = _rows(file, names)
    return _unpacked(file, rows, 1 + len(names)) if max(sizes, default=0) > LARGE else rows


def _unpacked(file: Path, rows: Iterator[Rows], width: int) -> Iterator[Rows]:
    """Yield the rows of a file, of ``width`` numbers each, through a temporary file."""
    try:
        with TemporaryFile() as disk:
            for t, values in rows:
                disk.write(np.column_stack([t, values]).tobytes())
            disk.seek(0)
            while piece := disk.read(ROWS * width * NUMBER_BYTES):
                numbers = np.frombuffer(piece).reshape(-1, width)
                yield numbers[:, 0], numbers[:, 1:]
    except OSError as error:
        advice = "free space there, or name another folder in TMPDIR"
        raise LogError(f"{file}: cannot be unpacked to {gettempdir()} ({error.strerror}); {advice}") from error


@contextmanager
def _opened(file: Path) -> Iterator[Any]:
    """Open a Parquet file; its errors, including those within the block, become a LogError."""
    try:
        from pyarrow import ArrowException
        from pyarrow.parquet import ParquetFile
    except ImportError as error:
        raise LogError(f"{file}: Parquet needs pyarrow: {how_to_install('fleet')}") from error
    try:
        with ParquetFile(file, buffer_size=BUFFER) as table:
            yield table
    except (ArrowException, OSError) as error:
        reason = " ".join(str(error).split())
        raise LogError(f"{file}: cannot be read as Parquet ({reason}); copy it anew, or delete it") from error


def _rows(file: Path, names: list[str]) -> Iterator[Rows]:
    """Yield the rows of a file from Arrow, ROWS at a time."""
    with _opened(file) as table:
        there = set(table.schema_arrow.names)
        time = next((name for name in TIMES if name in there), None)
        if time is None:
            raise LogError(f"{file}: no column of times ({', '.join(TIMES)}); give another lake")
        wanted = [name for name in names if name in there]
        for batch in table.iter_batches(ROWS, columns=[time, *wanted], use_threads=False) if wanted else ():
            values = np.full((batch.num_rows, len(names)), np.nan)
            for name in wanted:
                values[:, names.index(name)] = _numbers(file, name, batch.column(name))
            yield _times(file, time, batch.column(time)), values


def _numbers(file: Path, name: str, column: Any) -> Floats:
    import pyarrow as pa

    if not (pa.types.is_floating(column.type) or pa.types.is_integer(column.type) or pa.types.is_boolean(column.type)):
        raise LogError(f"{file}: column {name} holds no numbers but {column.type}; bind another signal")
    # Not Arrow's cast: it loads pyarrow.compute, 15 MiB. numpy makes NaN of None, which booleans have for no value.
    return column.to_numpy(zero_copy_only=False).astype(np.float64)  # type: ignore[no-any-return]


def _times(file: Path, name: str, column: Any) -> Floats:
    """Times (n,) [s]; dates without a time zone are in UTC."""
    import pyarrow as pa

    if column.null_count:
        raise LogError(f"{file}: column {name} has {column.null_count} rows without a time; delete them")
    if pa.types.is_timestamp(column.type):
        return column.view(pa.int64()).to_numpy() / PER_SECOND[column.type.unit]  # type: ignore[no-any-return]
    return _numbers(file, name, column)


def _side_by_side(parts: Sequence[Iterator[Frames]]) -> Iterator[tuple[Frames, "np.ndarray[Any, np.dtype[np.intp]]"]]:
    """Yield frames of several streams in order of time, with their streams, as far as all streams are complete.

    Each stream is read up to the time that the slowest one has reached.
    """
    held: list[Frames] = [next(part, None) or Frames.concatenate([]) for part in parts]
    while any(map(len, held)):
        until = min(float(frames.t[-1]) for frames in held if len(frames))
        cuts = [int(np.searchsorted(frames.t, until, side="right")) for frames in held]
        ready = [frames[:cut] for frames, cut in zip(held, cuts, strict=True)]
        joined = Frames.concatenate([frames for frames in ready if len(frames)])
        order = np.argsort(joined.t, kind="stable")
        yield joined[order], np.repeat(np.arange(len(parts)), cuts)[order]
        held = [frames[cut:] for frames, cut in zip(held, cuts, strict=True)]
        held = [frames if len(frames) else next(part, frames) for frames, part in zip(held, parts, strict=True)]

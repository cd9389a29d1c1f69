"""Writing of frames to log files, in the formats that python-can writes."""

from collections.abc import Callable
from io import TextIOWrapper
from pathlib import Path
from typing import BinaryIO

import can

from estimator.can_io.frames import Frames
from estimator.errors import LogError
from estimator.output_files import whole

TEXT_WRITERS: dict[str, Callable[[TextIOWrapper], can.io.generic.MessageWriter]] = {
    ".asc": can.ASCWriter,
    ".log": can.CanutilsLogWriter,
    ".csv": can.CSVWriter,
    ".trc": can.TRCWriter,
}
WRITABLE = (".blf", *TEXT_WRITERS)


def write_log(frames: Frames, path: Path) -> None:
    """Write a log in the format of the path's suffix, completely or not at all.

    Raises
    ------
    LogError
        The suffix is of no known format.
    RoadloadError
        The file cannot be written.
    """
    suffix = path.suffix.lower()
    if suffix not in WRITABLE:
        raise LogError(f"{path}: cannot write this kind of log: choose one of {', '.join(WRITABLE)}")
    with whole(path) as file, _writer(file, suffix) as log:
        for message in frames.messages():
            log.on_message_received(message)


def _writer(file: BinaryIO, suffix: str) -> can.io.generic.MessageWriter:
    if suffix == ".blf":
        return can.BLFWriter(file)
    return TEXT_WRITERS[suffix](TextIOWrapper(file, encoding="utf-8", newline="\n"))

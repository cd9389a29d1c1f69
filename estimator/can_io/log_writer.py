"""Frames to log files, in the formats that python-can writes."""

from pathlib import Path

import can

from estimator.can_io.frames import Frames
from estimator.errors import LogError
from estimator.output_files import whole

WRITABLE = (".blf", ".asc", ".log", ".csv", ".trc")


def write_log(frames: Frames, path: Path) -> None:
    """Write a log in the format of the path's suffix; it appears whole or not at all.

    Raises
    ------
    LogError
        There is no such format.
    RoadloadError
        The file cannot be written.
    """
    try:
        with whole(path) as partial, can.Logger(partial) as log:
            for message in frames.messages():
                log.on_message_received(message)
    except ValueError as error:
        raise LogError(f"{path}: cannot write this kind of log: {error}") from error

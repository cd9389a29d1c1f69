"""The file in which a running daemon shows its status, written about once a second."""

import os
import sys
from pathlib import Path

import msgspec

from estimator.answers.answer import decode, encode
from estimator.answers.status import StatusAnswer
from estimator.daemon.reception.uptime import since_start
from estimator.errors import InputError
from estimator.input_files import MIB, read_bounded
from estimator.output_files import write as write_whole

MAX_BYTES = MIB  # bytes; a status has some kB
MAX_AGE = 10.0  # s, of a running daemon's status: ten times the period of writing


def write(path: Path, status: StatusAnswer) -> None:
    """Write a status whole or not at all.

    Raises
    ------
    RoadloadError
        The file cannot be written.
    """
    write_whole(path, encode(status), 0o644)


def read(path: Path) -> StatusAnswer:
    """Read a status.

    Raises
    ------
    InputError
        The file cannot be read, or is not a status of this version.
    """
    try:
        return decode(read_bounded(path, MAX_BYTES), StatusAnswer)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    except msgspec.ValidationError as error:
        raise InputError(
            f"{path}: is not a status of this version ({error}); restart the daemon, or delete the file"
        ) from None
    except (msgspec.DecodeError, UnicodeDecodeError):
        raise InputError(f"{path}: is not a status file; delete it") from None


def obstacle_to_status(status: StatusAnswer, now: float | None = None) -> str:
    """Reason why a status is not that of a running daemon; empty where it is."""
    age = (since_start() if now is None else now) - status.written_monotonic_s
    if not is_alive(status.pid):
        return f"process {status.pid}, which wrote it, has ended"
    if not 0 <= age <= MAX_AGE:
        if age < 0:
            return "written before the last start of the machine"
        return f"written {age:.0f} s ago, although a running daemon writes every second"
    return ""


def is_alive(pid: int) -> bool:
    """Whether a process exists; False on Windows, where no daemon runs, and `os.kill` sends Ctrl-C as signal 0."""
    if sys.platform == "win32":
        return False
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True

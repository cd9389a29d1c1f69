"""Small files, read up to a limit: an endless device or fifo does not fill the memory."""

import errno
import os
import stat
from pathlib import Path

from estimator.errors import StateError

MIB = 1 << 20


def read_bounded(path: Path, most: int) -> bytes:
    """Contents of a file of at most ``most`` bytes.

    Raises
    ------
    OSError
        The file cannot be read, or is larger.
    """
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise OSError(errno.EFBIG, f"is larger than {most / MIB:g} MiB", str(path))
    return data


def read_own(path: Path, most: int) -> bytes:
    """Contents of a file that this user keeps: no link, no pipe, of at most ``most`` bytes, written by nobody else.

    Raises
    ------
    OSError
        The file cannot be read, or is a link.
    StateError
        It is no such file.
    """
    # Not blocking: the path may be a pipe.
    descriptor = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC)
    with open(descriptor, "rb") as file:
        status = os.fstat(descriptor)
        check_owner(status)
        if not stat.S_ISREG(status.st_mode) or status.st_size > most:
            raise StateError("is no file, or too large for a state")
        return file.read(most + 1)


def check_owner(status: os.stat_result) -> None:
    """Refuse what another user has, or may write.

    Raises
    ------
    StateError
        It is so.
    """
    if status.st_uid != os.geteuid():
        raise StateError("belongs to another user; not trusted")
    if status.st_mode & stat.S_IWOTH:
        raise StateError("may be written by everybody; not trusted: chmod o-w")

"""Small files that a user names, read up to a limit: an endless device or fifo does not fill the memory."""

import errno
from pathlib import Path

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

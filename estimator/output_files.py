"""Output files: their names are refused early, their contents appear whole or not at all."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from estimator.errors import ConfigError, RoadloadError

PART = ".part"  # suffix of a file that is being written: whoever reads all files of a suffix does not see it

REMEDY = {
    errno.ENOSPC: "free space on the disk and run again",
    errno.EDQUOT: "free space on the disk and run again",
    errno.EFBIG: "allow larger files (ulimit -f) and run again",
    errno.EACCES: "check the permissions",
}


def check_suffix(path: Path, formats: tuple[str, ...]) -> None:
    """Refuse a file name before the work is done.

    Raises
    ------
    ConfigError
        The suffix is none of ``formats``, or there is no such folder.
    """
    if path.suffix.lower() not in formats:
        raise ConfigError(f"{path}: write it as one of {', '.join(formats)}")
    if not path.parent.is_dir():
        raise ConfigError(f"{path}: there is no folder {path.parent}; create it first")
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; give the name of a file")


@contextmanager
def whole(path: Path, mode: int = 0o666) -> Iterator[BinaryIO]:
    """A new, empty file in the same folder, which becomes ``path`` when all went well and vanishes otherwise.

    It is written through its descriptor only, so a symbolic link at its name, planted before or meanwhile, is not
    followed. ``mode`` is that of a new file, of which the umask takes its part.

    Raises
    ------
    RoadloadError
        The file cannot be written.
    """
    with _replacing(path) as temporary, open(temporary, "wb", opener=lambda *_: create(temporary, mode)) as file:
        yield file


def write(path: Path, content: bytes, mode: int) -> None:
    """Write a file whole or not at all, with this mode whatever the umask.

    Raises
    ------
    RoadloadError
        The file cannot be written.
    """
    with whole(path, mode) as file:
        if hasattr(os, "fchmod"):  # Windows has no such modes
            os.fchmod(file.fileno(), mode)
        file.write(content)


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """A temporary name that becomes ``path`` when all went well and vanishes otherwise."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}{PART}")  # another process may write the same file
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        remedy = f"; {REMEDY[error.errno]}" if error.errno in REMEDY else ""
        raise RoadloadError(f"{path}: cannot write: {error.strerror}{remedy}") from error
    finally:
        with suppress(OSError):  # where nothing could be written there is nothing to remove
            temporary.unlink()


def create(path: Path, mode: int) -> int:
    """Descriptor of a new file, open for writing; what was at its place, a file or a link, is removed before.

    Raises
    ------
    OSError
        It cannot be removed or created.
    """
    path.unlink(missing_ok=True)
    return os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)  # O_EXCL follows no link

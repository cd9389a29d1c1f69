"""Output files: their names are refused early, their contents appear whole or not at all."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from estimator.errors import ConfigError, RoadloadError


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
def whole(path: Path) -> Iterator[Path]:
    """A name to write to, which becomes ``path`` when all went well and vanishes otherwise.

    Raises
    ------
    RoadloadError
        The file cannot be written.
    """
    temporary = path.with_name(f".{path.name}.part")
    try:
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise RoadloadError(f"{path}: {error.strerror}") from error
    finally:
        temporary.unlink(missing_ok=True)

"""Files that every user may write are refused."""

import os
import stat
from pathlib import Path

from estimator.config import Config
from estimator.errors import ConfigError


def refuse_if_writable_by_all(path: Path) -> None:
    """Refuse a file that every user could change, itself or by way of its folder.

    Raises
    ------
    ConfigError
        Every user may write it, or its permissions cannot be read.
    """
    for place in (path, path.resolve().parent):
        try:
            mode = os.stat(place).st_mode
        except OSError as error:
            raise ConfigError(f"{place}: {error.strerror}") from error
        sticky = stat.S_ISDIR(mode) and mode & stat.S_ISVTX
        if mode & stat.S_IWOTH and not sticky:
            raise ConfigError(f"{place}: every user may write it, so it is not believed; chmod o-w {place}")


def check_files(path: Path | None, config: Config) -> None:
    """Refuse a configuration, or databases and a map it names, that every user may write.

    Raises
    ------
    ConfigError
        One of them is, or cannot be looked at.
    """
    named = [*config.bus.dbc, *([] if config.road.map is None else [config.road.map])]
    for file in [*([path] if path is not None else []), *map(Path, named)]:
        refuse_if_writable_by_all(file)

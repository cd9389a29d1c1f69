"""Names, passwords and tokens: one line of a file that other users can neither read nor write."""

import os
import stat
from pathlib import Path

from estimator.errors import ConfigError
from estimator.input_files import read_bounded

MAX_BYTES = 16 << 10  # bytes of a secret; a token with many claims has some kB


def read_secret(path: str, key: str) -> str:
    """The line in a file that the configuration names by ``key``.

    Raises
    ------
    ConfigError
        The file cannot be read, is open to every user, or is not one line of text.
    """
    try:
        mode = os.stat(path).st_mode
        content = read_bounded(Path(path), MAX_BYTES)
    except OSError as error:
        raise ConfigError(f"{key}: {path}: {error.strerror}") from error
    if mode & (stat.S_IROTH | stat.S_IWOTH):
        raise ConfigError(f"{key}: {path}: is open to every user; chmod o-rw {path}")
    try:
        text = content.decode().removesuffix("\n").removesuffix("\r")
    except UnicodeDecodeError:
        text = ""
    if not text or not text.isprintable():
        raise ConfigError(f"{key}: {path}: must hold one line of text and nothing else")
    return text

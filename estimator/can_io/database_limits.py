"""Limits of DBC files, checked before cantools parses them: it takes minutes and gigabytes for some files of 1 MB.

Parsing takes 8 us and up to 1 kB for each token, and 200 bytes for each character of a quoted text. For multiplexed
signals the time grows with the square of their number.
"""

import codecs
import errno
import os
import re
from collections.abc import Iterator
from pathlib import Path

from estimator.errors import DatabaseError
from estimator.input_files import MIB, read_bounded

MAX_BYTES = 8 * MIB  # bytes of all databases; one of all of J1939 has half of it, most of it comments
MAX_TOKENS = 400_000  # names, numbers, texts and other characters of all databases
MAX_TEXT = 1 << 16  # characters of a quoted text
MAX_SIGNALS = 1000  # of a message
_TOKEN = re.compile(r'"[^"]*"?|[\w.+-]+|\S')


def require_files(paths: list[str]) -> None:
    """Refuse names of DBC files that do not exist.

    Raises
    ------
    DatabaseError
        One does not.
    """
    for path in paths:
        if not Path(path).exists():
            raise DatabaseError(_not_read(path, os.strerror(errno.ENOENT)))


def _not_read(path: str, reason: str | None) -> str:
    return f"{path}: {reason}; correct bus.dbc, or give --dbc FILE.dbc"


def read_databases(paths: list[str]) -> Iterator[tuple[str, str]]:
    """Yield paths and texts of DBC files.

    Raises
    ------
    DatabaseError
        A file cannot be read, or exceeds a limit.
    """
    bytes_left, tokens_left = MAX_BYTES, MAX_TOKENS
    for path in paths:
        try:
            data = read_bounded(Path(path), MAX_BYTES)
        except OSError as error:
            raise DatabaseError(_not_read(path, error.strerror)) from error
        text = _text(data)
        bytes_left -= len(data)
        tokens_left -= _checked_tokens(path, text, tokens_left)
        if bytes_left < 0 or tokens_left < 0:
            raise DatabaseError(
                f"{path}: the databases have over {MAX_BYTES // MIB} MiB, or over {MAX_TOKENS:,} names, numbers and "
                "texts; take out what is not needed"
            )
        yield path, text


def _text(data: bytes) -> str:
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:  # what Windows tools write
        return data.decode("cp1252", errors="replace")


def _checked_tokens(path: str, text: str, most: int) -> int:
    """Number of tokens, counted up to one more than ``most``."""
    count = signals = 0  # of the message at hand; whatever else names signals ends with a semicolon
    for count, match in enumerate(_TOKEN.finditer(text), start=1):
        token = match[0]
        if count > most:
            break
        if len(token) > MAX_TEXT:
            location = _place(path, text, match)
            raise DatabaseError(f"{location}: a text of over {MAX_TEXT:,} characters; shorten it, or end it")
        if token in ("BO_", ";"):
            signals = 0
        elif token == "SG_":
            signals += 1
        if signals > MAX_SIGNALS:
            location = _place(path, text, match)
            raise DatabaseError(f"{location}: more than {MAX_SIGNALS:,} signals in a message; correct the DBC")
    return count


def _place(path: str, text: str, match: re.Match[str]) -> str:
    return f"{path}:{text.count(chr(10), 0, match.start()) + 1}"

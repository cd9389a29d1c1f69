"""Logs of a fleet, and the vehicle of each.

A source is a log, a folder, a glob, a list of logs or a URL of fsspec (``s3://bucket/truck-*/``).
"""

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from glob import glob
from pathlib import Path, PurePath, PurePosixPath
from tempfile import TemporaryDirectory
from typing import Any

from estimator.can_io.logs.lake import ANY, day_of, files_of, is_day
from estimator.errors import ConfigError, InputError, LogError, RoadloadError
from estimator.extras import how_to_install
from estimator.input_files import MIB, read_bounded
from estimator.streaming.log_frames import FRAMES, Kind

LIST = ".txt"  # suffix of a list of logs: a log a line, and its vehicle after a tab
MAX_LIST_BYTES = 64 * MIB  # bytes of a list; a million names need less
WILD = re.compile(r"[*?\[]")


@dataclass(frozen=True, order=True)
class LogFile:
    """Log, by path or URL, and the name of its vehicle."""

    source: str
    vehicle: str


@dataclass(frozen=True)
class LeftOut:
    """File, by path or URL, that is a log with other settings only."""

    source: str


@dataclass(frozen=True)
class Found:
    """Logs in the order of vehicles and names, and the files that are logs with other settings only."""

    logs: list[LogFile]
    left_out: list[str]


def find_logs(sources: Sequence[str], pattern: str | None = None, kind: Kind = FRAMES) -> Found:
    """Find the files of a ``kind``, each once.

    The vehicle is the first group of ``pattern`` in the path of the log. Without a pattern it is the first folder below
    the source, or the folder of the log if there is none.

    Raises
    ------
    InputError
        A source is missing, has no log or must not be read.
    ConfigError
        The pattern is no regular expression with a group, or matches the path of no log.
    """
    expression = None if pattern is None else _compiled(pattern)
    vehicle_of: dict[str, str] = {}
    left_out: set[str] = set()
    for source in sources:
        try:
            files = list(_found_in(source, kind))
        except PermissionError as error:
            raise InputError(f"{error.filename}: cannot be read ({error.strerror}); check its permissions") from error
        logs = [file for file in files if isinstance(file, LogFile)]
        if not logs and files:
            raise InputError(f"{source}: no logs there but {kind.others_are}; read them {kind.remedy}")
        if not logs:
            raise InputError(f"{source}: no logs there; give a log, folder or glob with {' '.join(kind.suffixes)}")
        for log in logs:
            vehicle_of.setdefault(log.source, _named(log, expression))
        left_out.update(file.source for file in files if isinstance(file, LeftOut))
    found = [LogFile(log, vehicle) for log, vehicle in vehicle_of.items()]
    return Found(sorted(found, key=lambda log: (log.vehicle, log.source)), sorted(left_out - vehicle_of.keys()))


def _compiled(pattern: str) -> re.Pattern[str]:
    try:
        expression = re.compile(pattern)
    except re.error as error:
        raise ConfigError(f"--vehicle {pattern}: no regular expression: {error}") from error
    if not expression.groups:
        raise ConfigError(f"--vehicle {pattern}: put the vehicle's part of the path in parentheses")
    return expression


def _named(log: LogFile, expression: re.Pattern[str] | None) -> str:
    if expression is None:
        return log.vehicle
    match = expression.search(log.source)
    if match is None or not match[1]:
        raise ConfigError(f"{log.source}: --vehicle {expression.pattern} finds no vehicle in this path")
    return match[1]


def _found_in(source: str, kind: Kind) -> Iterator[LogFile | LeftOut]:
    if "://" in source:
        yield from _remote(source, kind)
    elif Path(source).suffix == LIST and Path(source).is_file():
        yield from _listed(Path(source))
    elif Path(source).is_dir():
        for path in _files_below(Path(source), set()):
            if path.is_dir():
                yield LogFile(str(path), _vehicle(source, str(path / ANY)))
            elif (file := _file(str(path), source, kind)) is not None and path.is_file():
                yield file
    elif is_day(Path(source)) and files_of(Path(source)):
        yield LogFile(source, _device(source))
    elif Path(source).is_file():
        yield LogFile(source, _vehicle(source, source))
    elif WILD.search(source):
        for name in glob(source, recursive=True):
            if Path(name).is_dir():
                yield from _found_in(name, kind)
            elif (file := _file(name, name, kind)) is not None:
                yield file
    else:
        raise InputError(f"{source}: no such file or folder; check the path")


def _files_below(folder: Path, seen: set[tuple[int, int]]) -> Iterator[Path]:
    """Yield the files below a folder, following links; an unreadable folder is yielded in place of its files.

    ``seen`` are the devices and inodes of the parent folders, so that circular links end.
    """
    try:
        entries = sorted(folder.iterdir())
        status = folder.stat()
    except PermissionError:
        yield folder
        return
    if (inode := (status.st_dev, status.st_ino)) in seen:
        return
    for entry in entries:
        if os.path.isdir(entry):
            yield from _files_below(entry, seen | {inode})
        else:
            yield entry


def _listed(path: Path) -> Iterator[LogFile]:
    """Logs named in a list file; its paths are relative to the file."""
    try:
        lines = read_bounded(path, MAX_LIST_BYTES).decode("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise InputError(f"{path}: cannot be read as a list of logs, UTF-8 text ({reason}); correct it") from error
    for number, line in enumerate(lines, start=1):
        name, _, vehicle = line.strip().partition("\t")
        if not name:
            continue
        log = name if "://" in name else str(path.parent / name)
        if "://" not in name and not (files_of(Path(log)) if is_day(Path(log)) else Path(log).is_file()):
            remedy = f"correct or delete the line, or give {path.name} another suffix if it is a log itself"
            raise InputError(f"{path}:{number}: no such log: {log}; {remedy}")
        yield LogFile(log, vehicle.strip() or _vehicle(log, log))


def _remote(source: str, kind: Kind) -> Iterator[LogFile | LeftOut]:
    files, root = file_system(source)
    try:
        if WILD.search(root):
            names = [name for path in files.glob(root) for name in (files.find(path) if files.isdir(path) else [path])]
            root = root[: root.rfind("/", 0, WILD.search(root).start()) + 1]  # type: ignore[union-attr]
        else:
            names = files.find(root)
    except Exception as error:  # of any storage library
        raise InputError(f"{source}: cannot be listed ({_line(error)}); check the name and the credentials") from error
    for name in names:
        if (file := _file(name, root, kind)) is not None:
            yield replace(file, source=files.unstrip_protocol(file.source))


def _file(name: str, root: str, kind: Kind) -> LogFile | LeftOut | None:
    """Log that a file is, or belongs to; None if it is none. ``root`` is the source in which it was found."""
    if PurePath(name).name.startswith("."):
        return None
    if name.lower().endswith(kind.suffixes):
        return LogFile(name, _vehicle(root, name))
    if (day := day_of(Path(name).as_posix())) is not None:
        return LogFile(day, _device(day))
    return LeftOut(name) if name.lower().endswith(kind.others) else None


def _device(day: str) -> str:
    """Folder of the messages of a lake."""
    return PurePosixPath(day).parents[4].name or Path.cwd().name


def _vehicle(root: str, log: str) -> str:
    """Name of the first folder between a source and the log, or of the folder of the log."""
    path = PurePosixPath(Path(log).as_posix())
    base = PurePosixPath(Path(root).as_posix())
    below = path.relative_to(base).parts if path.is_relative_to(base) else ()
    if len(below) > 1:
        return below[0]
    return path.parent.name or Path.cwd().name


def file_system(url: str) -> tuple[Any, str]:
    """File system of a URL, and the path in it.

    Raises
    ------
    InputError
        fsspec or its package for this protocol is missing, or the protocol is unknown.
    """
    try:
        from fsspec.core import url_to_fs
    except ImportError as error:
        raise InputError(f"{url}: URLs need fsspec: {how_to_install('fleet')}") from error
    try:
        files, path = url_to_fs(url)
    except (ImportError, ValueError, OSError) as error:
        raise InputError(f"{url}: {_line(error)}") from error
    return files, str(path)


@contextmanager
def local_copy(source: str) -> Iterator[Path]:
    """Yield the log as a local file; that of a URL exists during the context, whose errors name the URL.

    Raises
    ------
    LogError
        The log cannot be fetched.
    """
    if "://" not in source:
        yield Path(source)
        return
    with TemporaryDirectory(prefix="roadload-") as folder:
        files, name = file_system(source)
        try:
            path = _fetch(files, name, Path(folder))
        except Exception as error:  # of any storage library
            raise LogError(f"{source}: cannot be fetched ({_line(error)})") from error
        try:
            yield path
        except RoadloadError as error:  # names the copy, which is gone when the message is read
            raise type(error)(str(error).replace(str(path), source)) from error


def _fetch(files: Any, name: str, folder: Path) -> Path:
    """Copy a log, or all files of a day of a lake, into a folder; returns its path there."""
    path = PurePosixPath(name)
    if not is_day(path):
        files.get_file(name, str(folder / path.name))
        return folder / path.name
    for source in files.glob(name):
        copy = folder.joinpath(*PurePosixPath(source).parts[-5:])
        copy.parent.mkdir(parents=True, exist_ok=True)
        files.get_file(source, str(copy))
    return folder.joinpath(*path.parts[-5:])


def _line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__

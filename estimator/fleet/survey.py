"""Survey of a log before the estimates: hash of its contents, and times."""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path

import numpy as np

from estimator.can_io.frames import EXTENDED, Frames
from estimator.can_io.j1939 import GLOBAL
from estimator.can_io.j1939_name import BYTES, Name
from estimator.can_io.j1939_node import ADDRESS_CLAIMED
from estimator.can_io.logs.channels import described
from estimator.can_io.logs.lake import files_of, is_day
from estimator.config import Config
from estimator.errors import RoadloadError
from estimator.fleet.sources import LogFile, local_copy
from estimator.streaming.log_frames import LogFrames

PIECE = 1 << 20  # bytes hashed at a time
WITHOUT_PRIORITY = EXTENDED | 0x3FFFFFF  # bits of an id
ENGINE_CLAIM = EXTENDED | ADDRESS_CLAIMED << 8 | GLOBAL << 8  # by the address 0, that of engine 1 (J1939-81)


@dataclass(frozen=True, kw_only=True)
class Survey:
    """Log with a summary of its contents.

    ``content`` is a hash of its bytes, empty if it cannot be read. ``start`` and ``end`` [s] are the times of its first
    and last frame. ``fault`` is the reason why it cannot be read to the end, else empty, and ``note`` a doubt.
    ``engine`` is the J1939 NAME with which the engine claimed its address, in hexadecimal, else empty.
    """

    log: LogFile
    content: str
    start: float
    end: float
    fault: str = ""
    note: str = ""
    engine: str = ""


def survey(log: LogFile, config: Config) -> Survey:
    """Read a log without decoding it."""
    content, engine, start, end = "", "", 0.0, 0.0
    try:
        with local_copy(log.source) as path:
            first = True
            logs = LogFrames([path], config)
            for frames in logs:
                start, first = (float(frames.t[0]) if first else min(start, float(frames.t.min()))), False
                end = max(end, float(frames.t.max()))
                engine = engine or _engine(frames)
            content = _content(path)
    except (RoadloadError, OSError) as error:
        return Survey(log=log, content=content, start=start, end=end, fault=_line(log, error))
    return Survey(log=log, content=content, start=start, end=end, note=_note(logs.mixed), engine=engine)


def _engine(frames: Frames) -> str:
    """NAME in the first address claim of the engine with a serial number; empty if there is none.

    With the serial number 0, units of one kind have equal NAMEs. A forged claim also has it, because the lowest NAME
    wins.
    """
    claims = np.flatnonzero((frames.ident & np.uint32(WITHOUT_PRIORITY) == ENGINE_CLAIM) & (frames.length == BYTES))
    names = (bytes(frames.data[claim, :BYTES]) for claim in claims)
    return next((name[::-1].hex().upper() for name in names if Name.from_bytes(name).identity), "")


def _note(mixed: Mapping[str, int]) -> str:
    return f"{described(mixed)} are read as one bus; choose with --channel" if mixed else ""


def _line(log: LogFile, error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if log.source in text else f"{log.source}: {text}"


def _content(path: Path) -> str:
    """Hash of the bytes of a file, or of the names and bytes of all files of a day of a lake."""
    digest = blake2b(digest_size=16)
    parts = files_of(path) if is_day(path) else [path]
    for part in parts:
        if len(parts) > 1:
            digest.update(os.fsencode(f"{'/'.join(part.parts[-5:])} {part.stat().st_size} "))
        with part.open("rb") as file:
            while piece := file.read(PIECE):
                digest.update(piece)
    return digest.hexdigest()

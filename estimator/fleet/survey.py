"""Hash and times of a log, read once before the estimates."""

from collections import Counter
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path

from estimator.errors import RoadloadError
from estimator.fleet.sources import LogFile, local_copy
from estimator.streaming.log_frames import no_progress, read_frames

PIECE = 1 << 20  # bytes hashed at a time


@dataclass(frozen=True, kw_only=True)
class Survey:
    """A log and its contents.

    ``content`` is a hash of its bytes, empty where it cannot be read; ``start`` and ``end`` are the times of its
    first and last frame [s], and ``fault`` is the reason why it cannot be read to the end, or empty.
    """

    log: LogFile
    content: str
    start: float
    end: float
    fault: str = ""


def survey(log: LogFile) -> Survey:
    """Read a log without decoding it."""
    content, start, end = "", 0.0, 0.0
    try:
        with local_copy(log.source) as path:
            first = True
            for frames in read_frames([path], no_progress, Counter()):
                start, first = (float(frames.t[0]) if first else start), False
                end = float(frames.t[-1])
            content = _content(path)
    except (RoadloadError, OSError) as error:
        return Survey(log=log, content=content, start=start, end=end, fault=_line(log, error))
    return Survey(log=log, content=content, start=start, end=end)


def _line(log: LogFile, error: Exception) -> str:
    text = " ".join(str(error).split())
    return text if log.source in text else f"{log.source}: {text}"


def _content(path: Path) -> str:
    """Hash of the bytes of a file."""
    digest = blake2b(digest_size=16)
    with path.open("rb") as file:
        while piece := file.read(PIECE):
            digest.update(piece)
    return digest.hexdigest()

"""Base of all log formats: a recorded log as an iterable of batches of frames."""

import gzip
import math
import zlib
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

from estimator.can_io.frames import Frames
from estimator.can_io.logs.channels import Channels
from estimator.can_io.logs.time_check import TimeCheck
from estimator.can_io.time_order import MAX_DELAY, MAX_TIME
from estimator.errors import LogError

BATCH = 131_072  # frames, the most in one batch: decoding one takes 1.6 ms and 80 ns a frame

ERROR_FRAME = "error frame"
REMOTE_FRAME = "remote frame"
GIVE_COLUMNS = (  # of a table that is no log
    'give its columns to estimate, inspect, check, diagnose or fleet: --map speed="COLUMN [km/h]" '
    '--map power="COLUMN [kW]"'
)


class Log(ABC):
    """Log file; iterating it reads the file from its beginning.

    Attributes
    ----------
    path : pathlib.Path
        Path of the file.
    skipped : collections.Counter[str]
        Entries of the file that are no data frames, by reason.
    channels : Channels
        Counts of data frames by channel, and choice of the channels that are yielded.
    progress : float
        Share of the file read so far, 0 to 1.
    batch : int
        Largest number of frames in a batch.
    content : str
        Name of what the file should hold, for messages.
    """

    batch = BATCH
    content = "CAN data frame"

    def __init__(self, path: Path, channels: Iterable[str] = ()) -> None:
        self.path = path
        self.skipped: Counter[str] = Counter()
        self.channels = Channels(channels)
        self.progress = 0.0

    def __iter__(self) -> Iterator[Frames]:
        """Yield the data frames in file order, at most ``batch`` at a time.

        Raises
        ------
        LogError
            The file is damaged, which is raised after the frames before the damage; it holds no data frame, or frames
            of several buses.
        """
        self.skipped.clear()
        self.channels.clear()
        self.progress = 0.0
        times = TimeCheck(self.path)
        empty = True
        for frames in self._from_zero(regroup(self._guarded(), self.batch)):
            self.channels.check_number(self.path)
            if self.channels.shared is not None:
                continue  # only to count the frames of each channel
            times.check(frames)
            empty = False
            yield frames
        times.finish()
        self.progress = 1.0
        if self.channels.counts:
            self.channels.check(self.path)
        if empty:
            others = ", ".join(f"{count} {reason}" for reason, count in sorted(self.skipped.items()))
            raise LogError(f"{self.path}: no {self.content} in it ({others or 'nothing at all'}); give another log")

    @abstractmethod
    def _read(self) -> Iterator[Frames]:
        """Yield frames in batches of any size, count ``skipped`` and set ``progress`` on the way."""

    def _from_zero(self, batches: Iterable[Frames]) -> Iterator[Frames]:
        """Yield the frames, shifted by whole seconds if the log begins before time 0."""
        later = 0.0
        for i, frames in enumerate(batches):
            if i == 0 and -MAX_TIME < frames.t[0] < 0:
                later = MAX_DELAY - math.floor(frames.t[0])
            yield replace(frames, t=frames.t + later) if later else frames

    def _guarded(self) -> Iterator[Frames]:
        try:
            yield from self._read()
        except gzip.BadGzipFile as error:
            raise LogError(
                f"{self.path}: is no gzip file ({error}); take .gz out of its name, or copy it anew"
            ) from error
        except (OSError, EOFError, zlib.error) as error:  # the disk, or a gzip file that is cut or damaged
            reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            raise LogError(f"{self.path}: cannot be read on ({reason}); copy or unpack it anew") from error


def start_of(path: Path, size: int) -> bytes:
    """The first bytes of a file, at most ``size``.

    Raises
    ------
    LogError
        There is no such file, or it cannot be read, or is empty.
    """
    try:
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise LogError(f"{path}: is no file but a pipe or a device; write the log to a file")
        if path.is_dir():
            next(path.iterdir(), None)  # raises where the folder must not be read
            raise LogError(f"{path}: is a folder; give a file in it")
        with path.open("rb") as file:
            start = file.read(size)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise LogError(f"{path}: no such file; check the path") from error
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror}); check its permissions") from error
    if not start:
        raise LogError(f"{path}: is empty; give another file")
    return start


def regroup(parts: Iterable[Frames], size: int) -> Iterator[Frames]:
    """Join and cut batches to ``size`` frames.

    Raises
    ------
    LogError
        Raised by ``parts``; the frames before it are yielded first.
    """
    held: list[Frames] = []
    count = 0
    damage: LogError | None = None
    source = iter(parts)
    while True:
        try:
            part = next(source)
        except StopIteration:
            break
        except LogError as error:
            damage = error
            break
        if not len(part):
            continue
        held.append(part)
        count += len(part)
        if count < size:
            continue
        joined = Frames.concatenate(held)
        whole = count - count % size
        for start in range(0, whole, size):
            yield joined[start : start + size]
        held = [joined[whole:]] if whole < count else []
        count -= whole
    if held:
        yield Frames.concatenate(held)
    if damage is not None:
        raise damage

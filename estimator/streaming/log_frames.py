"""Frames of consecutive logs."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from estimator.can_io.bound_traffic import bound_messages
from estimator.can_io.frames import Frames
from estimator.can_io.logs import FORMATS, Log, open_log
from estimator.can_io.logs.lake import LakeLog, is_day
from estimator.can_io.logs.table import SUFFIXES, TableLog
from estimator.config import Config
from estimator.errors import LogError

Progress = Callable[[float], None]  # called with the share of the work that is done


def no_progress(share: float) -> None:
    """Ignore the progress ``share``."""


def as_paths(paths: str | Path | Sequence[str | Path]) -> list[Path]:
    """Convert a path, or a sequence of paths, to a list of `Path`."""
    return [Path(paths)] if isinstance(paths, str | Path) else [Path(path) for path in paths]


@dataclass(frozen=True, kw_only=True)
class Kind:
    """Suffixes of the files that are logs with a configuration, and of ``others`` that are logs with another one only.

    ``others_are`` and ``remedy`` say what the others are, and how they are read.
    """

    suffixes: tuple[str, ...]
    others: tuple[str, ...]
    others_are: str
    remedy: str


FRAMES = Kind(
    suffixes=tuple(FORMATS),
    others=tuple(suffix for suffix in SUFFIXES if suffix not in (*FORMATS, ".txt")),  # which may be any text
    others_are="tables",
    remedy="with --map or [table]",
)
TABLES = Kind(
    suffixes=SUFFIXES,
    others=tuple(suffix for suffix in FORMATS if suffix not in SUFFIXES),
    others_are="logs of frames",
    remedy="without --map and [table]",
)


def kind_of(config: Config) -> Kind:
    """Kind of the files that are logs with a configuration: tables if it has a table."""
    return FRAMES if config.table is None else TABLES


class LogFrames:
    """Iterable over batches of frames of consecutive logs, on the channels that the configuration names.

    Attributes
    ----------
    skipped : collections.Counter[str]
        Entries of the logs that are no data frames, by reason.
    mixed : collections.Counter[str]
        Frames by channel of logs whose channels are read as one bus; empty with one channel, or if some are chosen.

    Raises
    ------
    LogError
        A log is missing, empty or of an unknown format; on iterating, it is damaged or its channels exclude each other.
    """

    def __init__(self, paths: Sequence[Path], config: Config, progress: Progress = no_progress) -> None:
        self._channels = [str(channel) for channel in config.bus.channels]
        self._logs: list[Log] = [self._open(path, config) for path in paths]
        self._progress = progress
        self.skipped: Counter[str] = Counter()
        self.mixed: Counter[str] = Counter()

    def _open(self, path: Path, config: Config) -> Log:
        if config.table is not None:
            if self._channels:
                raise LogError(
                    f"{path}: is read as a table, which has no channels; take out --channel, or bus.channels"
                )
            return TableLog(path, config.table)
        if not is_day(path):
            if config.lake is not None:
                raise LogError(
                    f"{path}: is no day of a lake (DEVICE/*/2024/01/15/*.parquet); take the table [lake] out"
                )
            return open_log(path, self._channels)
        if config.lake is None:
            raise LogError(f"{path}: holds decoded signals; give a configuration with a table [lake], and their units")
        return LakeLog(path, self._channels, bound_messages(config))

    def __iter__(self) -> Iterator[Frames]:
        for i, log in enumerate(self._logs):
            for frames in log:
                yield frames
                self._progress((i + log.progress) / len(self._logs))
            self.skipped.update(log.skipped)
            if len(log.channels.counts) > 1 and not self._channels:
                self.mixed.update(log.channels.counts)

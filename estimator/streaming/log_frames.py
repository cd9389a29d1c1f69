"""Frames of one log after the other."""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from estimator.can_io.frames import Frames
from estimator.can_io.logs import Log, open_log

Progress = Callable[[float], None]  # called with the share of the work that is done


def no_progress(share: float) -> None:
    """Ignore the progress."""


def read_frames(paths: Sequence[Path], progress: Progress, skipped: Counter[str]) -> Iterator[Frames]:
    """Batches of all logs, one log after the other; counts the frames that are no data frames in ``skipped``.

    Raises
    ------
    LogError
        A log is missing, empty or damaged.
    """
    logs: list[Log] = [open_log(path) for path in paths]
    for i, log in enumerate(logs):
        for frames in log:
            yield frames
            progress((i + log.progress) / len(logs))
        skipped.update(log.skipped)

"""Diagnosis of logs of one vehicle; a log holds one drive or several."""

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from estimator.blas_threads import one_blas_thread
from estimator.can_io.frames import Frames
from estimator.config import Config
from estimator.diagnosis.diagnose import diagnose
from estimator.diagnosis.result import Diagnosis
from estimator.errors import LogError
from estimator.model.effects import CATALOGUE, Effect, named
from estimator.preparation.drive import Drive
from estimator.samples import Rows
from estimator.streaming.log_frames import LogFrames, Progress, as_paths, no_progress
from estimator.streaming.references import References
from estimator.streaming.row_stream import Block, RowStream

READING_SHARE = 0.9  # of the work
MAX_TORQUE_DIFFERENCE = 0.01  # of the reference torque of one engine in two logs


@one_blas_thread()
def diagnose_logs(
    paths: str | Path | Sequence[str | Path],
    config: Config,
    progress: Progress = no_progress,
    further: Sequence[Effect] = (),
    surrogates: int = 0,
) -> Diagnosis:
    """Diagnose one log, or several logs of one vehicle together.

    ``further`` effects are candidates beside those of the catalogue. ``surrogates`` are records of noise alone, in
    which effects are looked for as well, for a p-value.

    Raises
    ------
    LogError
        A log cannot be read, or is given twice.
    MissingInputsError
        A log lacks inputs of the model.
    ConfigError
        The configuration names an effect that is not known.
    """
    given = named(config.effects)
    drives = list[Drive]()
    mixed: Counter[str] = Counter()
    given_paths = as_paths(paths)
    _require_different(given_paths)
    torques, references = list[float | None](), list[References]()
    for i, path in enumerate(given_paths):
        logs = LogFrames([path], config, partial(_report_share, progress, i, len(given_paths)))
        stream = RowStream(config)
        in_log = _without_rows(rows_of(logs, stream, str(path)), config)
        torques.append(stream.reference_torque)
        references.append(stream.references)
        mixed.update(logs.mixed)
        drives += [replace(drive, log=i, log_start=in_log[0].start) for drive in in_log]
    result = diagnose(
        drives, given, np.random.default_rng(config.sampler.seed), (*CATALOGUE, *further), surrogates=surrogates
    )
    progress(1.0)
    final, deviation = result.final, result.deviation
    mass = None if final is None or deviation is None else (final.mass, deviation.mass)
    return replace(
        result,
        logs=tuple(map(str, given_paths)),
        references=references[-1].answer(None, mass, None),
        doubts=tuple(_other_engines(torques)),
        mixed_channels=dict(mixed),
    )


def _require_different(paths: Sequence[Path]) -> None:
    """Refuse a log that is given twice: its evidence would count twice."""
    real_paths = [os.path.realpath(path) for path in paths]
    for i, real_path in enumerate(real_paths):
        if real_path in real_paths[:i]:
            raise LogError(f"{paths[i]}: is given twice, and would count as evidence of its own; take one out")


def _other_engines(torques: Sequence[float | None]) -> Iterator[str]:
    """Yield reasons why logs with these reference torques [N m] may be of different vehicles."""
    by_log = [(i, torque) for i, torque in enumerate(torques, start=1) if torque is not None]
    for i, torque in by_log[1:]:
        first, other = by_log[0]
        if abs(torque - other) > MAX_TORQUE_DIFFERENCE * other:
            yield (
                f"the engine's reference torque is {other:,.0f} N m in log {first} and {torque:,.0f} N m in log {i}: "
                "two vehicles?"
            )


@one_blas_thread()
def diagnose_drive(paths: Sequence[Path], config: Config) -> Diagnosis:
    """Diagnose one drive that was recorded in consecutive files.

    Raises
    ------
    LogError
        A file cannot be read.
    MissingInputsError
        The files lack inputs of the model.
    """
    frames = LogFrames(list(paths), config, no_progress)
    drives = _without_rows(rows_of(frames, RowStream(config), str(paths[0])), config)
    return diagnose(drives, named(config.effects), np.random.default_rng(config.sampler.seed))


def _without_rows(rows: Sequence[Sequence[Rows]], config: Config) -> list[Drive]:
    """Drives of ``rows``, as a diagnosis takes them: the rows of an hour have 8 MB, and it needs the strides alone."""
    return [replace(Drive.of(pieces, config), pieces=()) for pieces in rows]


def _report_share(progress: Progress, done: int, of: int, share: float) -> None:
    progress((done + READING_SHARE * share) / of)


def drives_of(path: Path, config: Config, progress: Progress = no_progress) -> list[Drive]:
    """Read the drives in a log, in order of time.

    Raises
    ------
    LogError
        The log cannot be read.
    MissingInputsError
        The log lacks inputs of the model.
    """
    pieces = rows_of(LogFrames([path], config, progress), RowStream(config), str(path))
    return [Drive.of(rows, config) for rows in pieces]


def rows_of(frames: Iterable[Frames], stream: RowStream, source: str) -> list[list[Rows]]:
    """Rows of each drive in traffic, cut into pieces at interruptions.

    Raises
    ------
    MissingInputsError
        The traffic, which comes from ``source``, lacks inputs of the model.
    """
    drives: list[list[list[Rows]]] = [[[]]]
    for item in stream.feed_all(frames):
        if isinstance(item, Block):
            drives[-1][-1] += item.rows
        elif item.is_new_drive:
            drives.append([[]])
        else:
            drives[-1].append([])
    stream.require_inputs(source)
    pieces = [[Rows.concatenate(*parts) for parts in drive if parts] for drive in drives]
    return [drive for drive in pieces if drive]

"""Recorded traffic to a diagnosis: each log is a drive of the same vehicle, or several."""

from collections import Counter
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np

from estimator.config import Config
from estimator.diagnosis.diagnose import diagnose
from estimator.diagnosis.record import Record, record
from estimator.diagnosis.result import Diagnosis
from estimator.effects import named
from estimator.pipeline import NEW_DRIVE, Pipeline
from estimator.replay import Progress, read
from estimator.samples import STEP, Rows

READING = 0.9  # of the work
NEVER = 1e9  # s: the pipeline is only to align, the diagnosis fits for itself


def diagnose_logs(paths: list[Path], config: Config, progress: Progress) -> Diagnosis:
    """Diagnose one log, or several of one vehicle together.

    Raises
    ------
    LogError
        A log cannot be read.
    MissingInputsError
        A log does not carry what the model needs.
    ConfigError
        The configuration names an effect that is not known.
    """
    given = named(config.effects)
    records: list[Record] = []
    for i, path in enumerate(paths):
        found = drives(path, config, partial(_part, progress, i, len(paths)))
        records += [replace(drive, log=i, log_start=found[0].start) for drive in found]
    result = diagnose(records, given, np.random.default_rng(config.sampler.seed))
    progress(1.0)
    return replace(result, logs=tuple(str(path) for path in paths))


def _part(progress: Progress, done: int, of: int, share: float) -> None:
    progress((done + READING * share) / of)


def drives(path: Path, config: Config, progress: Progress) -> list[Record]:
    """The drives in a log: a silence of NEW_DRIVE, or a step back in time, begins another."""
    plain = msgspec.structs.replace(config, gate=msgspec.structs.replace(config.gate, interval_s=NEVER), effects=[])
    rows: list[Rows] = []
    pipeline = Pipeline(plain, tap=rows.append)
    for frames in read([path], progress, Counter()):
        for _ in pipeline.feed(frames):
            pass
    for _ in pipeline.finish():
        pass
    pipeline.require_inputs(str(path))
    found: list[list[list[Rows]]] = []
    last: int | None = None
    for part in rows:
        gap = None if last is None else int(part.index[0]) - last - 1
        if gap is None or not 0 <= gap * STEP <= NEW_DRIVE:
            found.append([[part]])
        elif gap:
            found[-1].append([part])
        else:
            found[-1][-1].append(part)
        last = int(part.index[-1])
    return [record([Rows.concatenate(*piece) for piece in pieces], config) for pieces in found]

"""Signals of MF4 files as tables: the wanted channels by asammdf, a row for each time that any of them has.

asammdf reads in a process of its own (`mf4_signals`): a damaged file may end it, hold it up, or fill the memory.
"""

import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np

from estimator.can_io.logs.mf4_signals import TIME, Answer
from estimator.can_io.logs.table_piece import ROWS, Piece, Wanted
from estimator.errors import LogError
from estimator.extras import how_to_install
from estimator.signals import Floats

READER = "estimator.can_io.logs.mf4_signals"


def read(path: Path, wanted: Wanted) -> Iterator[Piece]:
    """Pieces of the wanted channels; their times are seconds since the start of the file.

    Raises
    ------
    LogError
        asammdf is missing, the file is damaged, or has a channel more than once, or too much of it.
    """
    if find_spec("asammdf") is None:
        raise LogError(f"{path}: signals of MF4 need asammdf: {how_to_install('tables')}")
    yield from _rows(_answer(path, wanted))


def _answer(path: Path, wanted: Wanted) -> Answer:
    modules = os.pathsep.join(filter(None, sys.path))
    with TemporaryFile() as file:
        reading = subprocess.run(
            [sys.executable, "-P", "-m", READER, str(path)],
            input=pickle.dumps(wanted),
            stdout=file,
            stderr=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": modules},
            check=False,
        )
        if reading.returncode:
            end = f"asammdf ended with status {reading.returncode}"
            raise LogError(f"{path}: cannot be read as MF4: damaged, or too large ({end}); copy it anew, or cut it")
        file.seek(0)
        answer: Answer | str = pickle.load(file)  # of this program
    if isinstance(answer, str):
        raise LogError(f"{path}: {answer}")
    return answer


def _rows(answer: Answer) -> Iterator[Piece]:
    names, series, units = answer
    others: dict[str, Any] = dict.fromkeys(names, ())
    times = np.unique(np.concatenate([np.empty(0), *(t for t, _ in series.values())]))
    for first in range(0, len(times), ROWS):
        part = times[first : first + ROWS]
        cells = {name: _at(part, *values) for name, values in series.items()}
        yield Piece({**others, TIME: part, **cells}, min((first + ROWS) / len(times), 1.0), units)


def _at(times: Floats, t: Floats, value: Floats) -> Floats:
    """Values at their own times among ``times`` (n,), NaN at the others."""
    found = np.full(len(times), np.nan)
    inside = slice(np.searchsorted(t, times[0], side="left"), np.searchsorted(t, times[-1], side="right"))
    found[np.searchsorted(times, t[inside])] = value[inside]
    return found

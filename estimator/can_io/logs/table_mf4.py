"""Signals of MF4 files as tables: the wanted channels by asammdf, a row for each time that any of them has."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from estimator.can_io.logs.table_piece import ROWS, Piece, Wanted
from estimator.errors import LogError
from estimator.extras import how_to_install
from estimator.signals import Floats

MAX_SAMPLES = 1 << 26  # of all wanted channels: 1 GiB with their times
TIME = "time"


def read(path: Path, wanted: Wanted) -> Iterator[Piece]:
    """Pieces of the wanted channels; their times are seconds since the start of the file.

    Raises
    ------
    LogError
        asammdf is missing, the file is damaged, or has a channel more than once, or too much of it.
    """
    try:
        from asammdf.blocks.mdf_v4 import MDF4
        from asammdf.blocks.utils import MdfException
    except ImportError as error:
        raise LogError(f"{path}: signals of MF4 need asammdf: {how_to_install('tables')}") from error

    class Measurement(MDF4):
        def __del__(self) -> None:
            """Close what opening left open; MDF4 itself fails here where that came to no end."""
            if (temporary := getattr(self, "_tempfile", None)) is not None:
                temporary.close()

    try:
        inner: Any = {"original_name": str(path), "__internal__": True}  # as asammdf.MDF itself opens it
        with path.open("rb") as stream, closing(Measurement(stream, **inner)) as file:
            chosen = sorted(wanted([*file.channels_db, TIME]) & set(file.channels_db) - {TIME})
            places = {name: file.channels_db[name] for name in chosen}
            for name, several in places.items():
                if len(several) > 1:
                    raise LogError(f"{path}: has the channel {name!r} {len(several)} times; export the one you mean")
            counts = [file.groups[group].channel_group.cycles_nr for ((group, _),) in places.values()]
            if sum(counts) > MAX_SAMPLES:
                raise LogError(f"{path}: the channels have {sum(counts):,} samples; cut the file into parts")
            series = {name: file.get(name) for name in chosen}
            values = {name: (np.asarray(x.timestamps), np.asarray(x.samples)) for name, x in series.items()}
            others = dict.fromkeys(file.channels_db, ())
    except (MdfException, OSError, ValueError, KeyError, IndexError, TypeError, AttributeError, OverflowError) as error:
        reason = " ".join(str(error).split())[:100]
        raise LogError(f"{path}: cannot be read as MF4 ({reason}); copy it anew") from error
    yield from _rows(others, values)


def _rows(others: dict[str, Any], values: dict[str, tuple[Floats, Any]]) -> Iterator[Piece]:
    times = np.unique(np.concatenate([np.empty(0), *(t for t, _ in values.values())]))
    for first in range(0, len(times), ROWS):
        part = times[first : first + ROWS]
        cells = {name: _at(part, *values[name]) for name in values}
        yield Piece({**others, TIME: part, **cells}, min((first + ROWS) / len(times), 1.0))


def _at(times: Floats, t: Floats, value: Any) -> Floats:
    """Values at their own times among ``times`` (n,), NaN at the others; text is not a number."""
    found = np.full(len(times), np.nan)
    inside = slice(np.searchsorted(t, times[0], side="left"), np.searchsorted(t, times[-1], side="right"))
    if value.dtype.kind in "fiub":
        found[np.searchsorted(times, t[inside])] = value[inside]
    return found

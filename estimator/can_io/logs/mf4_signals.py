"""Program that reads channels of an MF4 file by asammdf: ``python -m estimator.can_io.logs.mf4_signals FILE``.

Standard input holds the pickled choice of channels, standard output gets the pickled answer: the channels, or the
reason why there are none. Memory and processor time are limited where the system can do that.
"""

import pickle
import sys
from contextlib import closing, redirect_stdout
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from estimator.can_io.logs.table_piece import Wanted
from estimator.errors import LogError
from estimator.signals import Floats

MAX_MEMORY = 1 << 32  # bytes of the process, of which 1 GiB are its libraries
SECONDS, BYTES_PER_SECOND = 10, 1e6  # of processor time, and more for each of so many bytes; usual: 50 MB a second
TIME, OF_TIME = "time", 1  # name of the column of times; kind of the master channel of a group
Series = tuple[Floats, Floats]  # times (n,) [s] and values (n,)
# Names of all channels, the wanted ones, and the units that the file gives them; plain, to be pickled.
Answer = tuple[list[str], dict[str, Series], dict[str, str]]


def main() -> int:
    """Read the channels and write the answer."""
    path, wanted = Path(sys.argv[1]), pickle.load(sys.stdin.buffer)  # of this program
    _limit(path.stat().st_size)
    answer: Answer | str
    try:
        with redirect_stdout(sys.stderr):  # what is printed on the way is no answer
            answer = read(path, wanted)
    except LogError as error:
        answer = str(error)
    except Exception as error:  # of any kind: asammdf and what it uses raise many on damaged files
        reason = " ".join(str(error).split())[:100] or type(error).__name__
        answer = f"cannot be read as MF4 ({reason}); copy it anew"
    pickle.dump(answer, sys.stdout.buffer)
    return 0


def read(path: Path, wanted: Wanted) -> Answer:
    """Read the wanted channels.

    Raises
    ------
    LogError
        A channel is there more than once, has no numbers, or its times step back; the path is left out of the message.
    Exception
        Of any kind, where the file is damaged.
    """
    from asammdf.blocks.mdf_v4 import MDF4

    inner: Any = {"original_name": str(path), "__internal__": True}  # as asammdf.MDF itself opens it
    with path.open("rb") as stream, closing(MDF4(stream, **inner)) as file:
        series, units = dict[str, Series](), {TIME: "s"}
        masters = {file.groups[group].channels[master].name for group, master in file.masters_db.items()}
        names = [name for name in file.channels_db if name not in masters]
        chosen = sorted(wanted(names) & set(names) - {TIME})
        for name in chosen:
            if (count := len(file.channels_db[name])) > 1:
                raise LogError(f"has the channel {name!r} {count} times; export the one you mean")
            ((group, _),) = file.channels_db[name]
            master = file.masters_db.get(group)
            if master is None or file.groups[group].channels[master].sync_type != OF_TIME:
                raise LogError(f"the channel {name!r} has no times; export it with them")
            signal: Any = file.get(name)
            series[name], units[name] = _series(name, signal), str(signal.unit)
        return names, series, units


def _series(name: str, signal: Any) -> Series:
    t, value = np.asarray(signal.timestamps, np.float64), np.asarray(signal.samples)
    if value.ndim != 1 or value.dtype.kind not in "fiub":
        raise LogError(f"the channel {name!r} holds no numbers; choose another one")
    if len(t) != len(value) or not np.all(np.diff(t) >= 0):
        raise LogError(f"the times of the channel {name!r} step back, or are no numbers; export it anew")
    return t, value.astype(np.float64)


def _limit(size: int) -> None:
    """Limit memory and processor time for a file of ``size`` bytes."""
    if find_spec("resource") is None:
        return
    import resource

    seconds = int(SECONDS + size / BYTES_PER_SECOND)
    resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds))
    resource.setrlimit(resource.RLIMIT_AS, (MAX_MEMORY, MAX_MEMORY))


if __name__ == "__main__":
    sys.exit(main())

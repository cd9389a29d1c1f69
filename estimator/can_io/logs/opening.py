"""Choice of the reader of a log file, by its suffix, or by its first line for logs of candump and OVMS.

A file that begins as another format does than its suffix says is refused with the right suffix.
"""

import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path

from estimator.can_io.logs.asc import AscLog
from estimator.can_io.logs.blf import BlfLog
from estimator.can_io.logs.candump import CandumpLog
from estimator.can_io.logs.candump_line import MAX_LINE, layout
from estimator.can_io.logs.crtd import CrtdLog
from estimator.can_io.logs.crtd import layout as crtd_layout
from estimator.can_io.logs.csv_text import CsvLog, decoded_table
from estimator.can_io.logs.line_layout import NOTHING, BadLineError, Layout
from estimator.can_io.logs.log import GIVE_COLUMNS, Log, start_of
from estimator.can_io.logs.mf4 import Mf4Log
from estimator.can_io.logs.table import SUFFIXES
from estimator.can_io.logs.trc import TrcLog
from estimator.errors import LogError

FORMATS: dict[str, type[Log]] = {
    ".asc": AscLog,
    ".asc.gz": AscLog,
    ".blf": BlfLog,
    ".blf.gz": BlfLog,
    ".crtd": CrtdLog,
    ".crtd.gz": CrtdLog,
    ".csv": CsvLog,
    ".csv.gz": CsvLog,
    ".log": CandumpLog,
    ".log.gz": CandumpLog,
    ".mf4": Mf4Log,
    ".mf4.gz": Mf4Log,
    ".trc": TrcLog,
    ".trc.gz": TrcLog,
}
TEXTS: dict[type[Log], Callable[[bytes], Layout]] = {CandumpLog: layout, CrtdLog: crtd_layout}
TABLES = tuple(suffix for suffix in SUFFIXES if suffix not in {*FORMATS, ".txt"})  # a log may be a .txt, too
STARTS = {  # what files of a format begin with
    ".gz": rb"\x1f\x8b",
    ".blf": rb"LOGG",
    ".mf4": rb"MDF |UnFinMF",
    ".asc": rb"date [^,;\r\n]*\r?\nbase (hex|dec)",
    ".trc": rb";\$FILEVERSION",
    ".csv": rb"(\xef\xbb\xbf)?(?!date |base |//)[A-Za-z][^\x00-\x1f,;]*([,;\t][^\x00-\x1f,;]*){2,}\r?\n",
}


def open_log(path: str | os.PathLike[str], channels: Iterable[str] = ()) -> Log:
    """Open a recorded log.

    Parameters
    ----------
    path : str or os.PathLike[str]
        File whose suffix, in upper or lower case, is one of ``FORMATS``, or that has lines of candump or OVMS.
    channels : Iterable[str]
        Names of the channels that are read, as in the log; all channels if empty.

    Returns
    -------
    Log
        Iterable of ``Frames``; nothing but the presence of the file has been checked.

    Raises
    ------
    LogError
        The file does not exist, cannot be read, is empty, or has an unknown format.
    """
    path = Path(path)
    start = start_of(path, MAX_LINE)
    name = path.name.lower()
    reader = next((log for suffix, log in FORMATS.items() if name.endswith(suffix)), None)
    suffix = _suffix_by_start(start)
    if reader and suffix and not name.endswith(".gz") and FORMATS.get(suffix) is not reader:
        raise LogError(f"{path}: begins as a {suffix} file does; rename it to {_renamed(path, suffix)}")
    if reader is None:
        reader = next((log for log, parse in TEXTS.items() if _begins_with(parse, start)), None)
    if reader is None and name.endswith(TABLES):
        raise LogError(decoded_table(path))
    if reader is None:
        raise LogError(
            f"{path}: unknown log format '{path.suffix}'; rename it if it is one of {', '.join(FORMATS)}, "
            f"or export it as one of them from the tool that recorded it; if it holds a table of values, {GIVE_COLUMNS}"
        )
    return reader(path, channels)


def _suffix_by_start(start: bytes) -> str:
    """Suffix of the format that a file of such a ``start`` has; empty if its first bytes do not tell."""
    named = next((suffix for suffix, begin in STARTS.items() if re.match(begin, start)), "")
    return named or (".log" if _begins_with(layout, start) else "")


def _renamed(path: Path, suffix: str) -> str:
    return f"{path.name}{suffix}" if suffix == ".gz" else f"{path.stem}{suffix}"


def _begins_with(parse: Callable[[bytes], Layout], start: bytes) -> bool:
    """True if the first line that is not blank has a frame."""
    lines = start.lstrip().splitlines()
    try:
        return bool(lines) and parse(lines[0]) is not NOTHING
    except BadLineError:
        return False

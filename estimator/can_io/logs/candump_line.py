"""Grammar of a line of candump output: the layout of its values, or the error of a line that does not match.

``candump -l``: ``(1436509052.249713) can0 18FEF100#0011223344556677``, ``123##1AABB`` for CAN FD, ``123#R`` remote.
On screen with ``-ta`` or ``-tz``: `` (000.005001)  can0  18FEF100   [8]  00 11 22 33 44 55 66 77``; with ``-tA`` date
and time of day, taken as UTC: `` (2023-11-14 22:13:20.000000)  can0``. Lines of ``-e``, which explain the error frame
before them, begin with a tab.
Ids of 3 digits are standard, of 8 digits extended, or error frames where bit 29 is set.
"""

import re
from datetime import UTC, datetime

from estimator.can_io.frames import CLASSIC_BYTES, FD_BYTES
from estimator.can_io.logs.line_layout import (
    ERROR_FLAG,
    MAX_EXTENDED_ID,
    MAX_STANDARD_ID,
    NOTHING,
    BadLineError,
    Layout,
    shown,
)

MAX_LINE = 1024  # bytes; the longest that candump prints has about 350
EXAMPLE = "'(1436509052.249713) can0 18FEF100#0011223344556677' or ' (000.005001)  can0  18FEF100   [2]  00 11'"

_TIME = (
    rb"\s*\((?:(?P<minute>\d{4}-\d\d-\d\d \d\d:\d\d):)?(?P<seconds>\d{1,12})\.(?P<fraction>\d{1,9})\)\s+"
    rb"(?P<channel>\S+)\s+"
)
_ID = rb"(?P<id>[0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})"
_FILE_FORM = re.compile(
    _TIME + _ID + rb"#(?:(?P<remote>R[0-9A-Fa-f_]{0,3})|#[0-9A-Fa-f](?P<fd>(?:[0-9A-Fa-f]{2})*)"
    rb"|(?P<classic>(?:[0-9A-Fa-f]{2})*)(?:_[0-9A-Fa-f])?)(?:[ \t][ -~\t]*)?\r?"
)
_SCREEN_FORM = re.compile(
    _TIME + rb"(?:[TR]X [B-] [E-]\s+)?" + _ID + rb"\s+\[(?P<length>\d{1,2})\] *"
    rb"(?:(?P<remote> remote request)|(?P<data>(?: [0-9A-Fa-f]{2})*))(?:\s+ERRORFRAME)?(?:\s+'[ -~]*')?\s*"
)
_EXPLANATION = re.compile(rb"\t[a-z][ -~]*")
_NO_TIME = re.compile(rb"\s*\S+\s+(?:[TR]X [B-] [E-]\s+)?[0-9A-Fa-f]{3,8}(?:\s+\[\d+\]|#)")


def layout(line: bytes) -> Layout:
    """Parse a line.

    Raises
    ------
    BadLineError
        The line is neither blank nor in one of the two forms.
    """
    if not line.strip() or _EXPLANATION.fullmatch(line):
        return NOTHING
    if len(line) > MAX_LINE:
        raise BadLineError(f"expected {EXAMPLE}, found a line of {len(line)} bytes")
    if match := _FILE_FORM.fullmatch(line):
        fd = match["fd"] is not None
        first, last = match.span("fd" if fd else "classic")
        data = range(max(first, 0), max(last, 0), 2)
        end = max(last, match.end("remote"))
    elif match := _SCREEN_FORM.fullmatch(line):
        fd = len(match["length"]) == 2  # candump pads the length of FD frames to two digits
        first, last = match.span("data")
        data = range(first + 1, max(last, first + 1), 3)
        end = max(last, match.end("length") + 1, match.end("remote"))
        if not match["remote"] and len(data) != int(match["length"]):
            raise BadLineError(f"expected {int(match['length'])} data bytes, found {len(data)}")
    elif _NO_TIME.match(line):
        raise BadLineError(
            "expected a time in parentheses first, without which no acceleration is known",
            remedy="record with candump -l or -ta",
        )
    else:
        raise BadLineError(f"expected {EXAMPLE}, found {shown(line)}")
    if len(data) > (FD_BYTES if fd else CLASSIC_BYTES):
        raise BadLineError(f"expected at most {FD_BYTES if fd else CLASSIC_BYTES} data bytes, found {len(data)}")
    extended = len(match["id"]) == 8
    largest = MAX_EXTENDED_ID | ERROR_FLAG if extended else MAX_STANDARD_ID
    if int(match["id"], 16) > largest:
        raise BadLineError(f"expected a CAN id, found {match['id'].decode()}, which is too large")
    return Layout(
        seconds=match.span("seconds"),
        fraction=match.span("fraction"),
        ident=match.span("id"),
        data=data,
        length=len(data),
        end=end,
        extended=extended,
        largest=largest,
        remote=match["remote"] is not None,
        channel=match["channel"],
        offset=_start_of(match["minute"]) if match["minute"] else 0.0,
    )


def _start_of(minute: bytes) -> float:
    """Seconds since 1970 of the start of a minute."""
    try:
        return datetime.strptime(minute.decode(), "%Y-%m-%d %H:%M").replace(tzinfo=UTC).timestamp()
    except ValueError as error:
        raise BadLineError(f"expected a date and a time of day, found '{minute.decode()}'") from error

"""One line of candump output: the grammar, where the values stand in it, and what is wrong with a line that fails.

``candump -l``: ``(1436509052.249713) can0 18FEF100#0011223344556677``, ``123##1AABB`` for CAN FD, ``123#R`` remote.
On screen with ``-ta`` or ``-tz``: `` (000.005001)  can0  18FEF100   [8]  00 11 22 33 44 55 66 77``.
Ids of 3 digits are standard, of 8 digits extended, or error frames where bit 29 is set.
"""

import re
from typing import NamedTuple

from estimator.can_io.frames import CLASSIC_BYTES, FD_BYTES

ERROR_FLAG = 0x20000000  # in an id of 8 digits
LARGEST_STANDARD = 0x7FF
LARGEST_EXTENDED = 0x1FFFFFFF | ERROR_FLAG
MAX_LINE = 1024  # bytes; the longest that candump prints has about 350
SHOWN = 60  # characters of a wrong line that a message quotes
EXAMPLE = "'(1436509052.249713) can0 18FEF100#0011223344556677' or ' (000.005001)  can0  18FEF100   [2]  00 11'"

_TIME = rb"\s*\((?P<seconds>\d{1,12})\.(?P<fraction>\d{1,9})\)\s+\S+\s+"
_ID = rb"(?P<id>[0-9A-Fa-f]{8}|[0-9A-Fa-f]{3})"
_FILE_FORM = re.compile(
    _TIME + _ID + rb"#(?:(?P<remote>R[0-9A-Fa-f_]{0,3})|#[0-9A-Fa-f](?P<fd>(?:[0-9A-Fa-f]{2})*)"
    rb"|(?P<classic>(?:[0-9A-Fa-f]{2})*)(?:_[0-9A-Fa-f])?)(?P<tail>[ \t][ -~\t]*)?\r?"
)
_SCREEN_FORM = re.compile(
    _TIME + rb"(?:[TR]X [B-] [E-]\s+)?" + _ID + rb"\s+\[(?P<length>\d{1,2})\] *"
    rb"(?:(?P<remote> remote request)|(?P<data>(?: [0-9A-Fa-f]{2})*))(?:\s+ERRORFRAME)?(?:\s+'[ -~]*')?\s*"
)
_NO_TIME = re.compile(rb"\s*\S+\s+(?:[TR]X [B-] [E-]\s+)?[0-9A-Fa-f]{3,8}(?:\s+\[\d+\]|#)")


class BadLineError(ValueError):
    """A line is not candump output; the message says what was expected."""


class Layout(NamedTuple):
    """Where the values stand in a line, as columns; a blank line has no id.

    ``seconds``, ``fraction`` and ``ident`` are (first, end) columns, ``data`` the columns of the payload bytes' first
    digits. ``tail`` is whether something follows the payload, which shows that it is complete.
    """

    seconds: tuple[int, int]
    fraction: tuple[int, int]
    ident: tuple[int, int]
    data: range
    remote: bool
    tail: bool


BLANK = Layout((0, 0), (0, 0), (0, 0), range(0), remote=False, tail=True)


def layout(line: bytes) -> Layout:
    """Parse a line.

    Raises
    ------
    BadLineError
        If it is neither blank nor in one of the two forms.
    """
    if not line.strip():
        return BLANK
    if len(line) > MAX_LINE:
        raise BadLineError(f"expected {EXAMPLE}, found a line of {len(line)} bytes")
    if match := _FILE_FORM.fullmatch(line):
        fd = match["fd"] is not None
        first, end = match.span("fd" if fd else "classic")
        data = range(max(first, 0), max(end, 0), 2)
        complete = bool((match["tail"] or b"").strip()) or len(data) == (FD_BYTES if fd else CLASSIC_BYTES)
    elif match := _SCREEN_FORM.fullmatch(line):
        fd = len(match["length"]) == 2  # candump pads the length of FD frames to two digits
        first, end = match.span("data")
        data = range(first + 1, max(end, first + 1), 3)
        complete = True  # the length says so
        if not match["remote"] and len(data) != int(match["length"]):
            raise BadLineError(f"expected {int(match['length'])} data bytes, found {len(data)}")
    elif _NO_TIME.match(line):
        raise BadLineError("expected a time in parentheses first; record with candump -l, -ta or -tz")
    else:
        shown = line.strip()[:SHOWN].decode("ascii", "replace")
        raise BadLineError(f"expected {EXAMPLE}, found {shown!r}")
    if len(data) > (FD_BYTES if fd else CLASSIC_BYTES):
        raise BadLineError(f"expected at most {FD_BYTES if fd else CLASSIC_BYTES} data bytes, found {len(data)}")
    if int(match["id"], 16) > (LARGEST_STANDARD if len(match["id"]) == 3 else LARGEST_EXTENDED):
        raise BadLineError(f"expected a CAN id, found {match['id'].decode()}, which is too large")
    return Layout(
        match.span("seconds"), match.span("fraction"), match.span("id"), data, match["remote"] is not None, complete
    )

"""Layout of a line of an .asc log, as CANalyzer, CANoe and python-can write it.

``   0.015991 1  CF00400x        Rx   d 8 F0 7D 82 BD 12 00 F4 82  Length = 0 ...`` and for CAN FD
``  30.005021 CANFD   1 Rx   300  SymbolicName   1 0 8  8 11 c2 03 04 05 06 07 08   102203 ...``
(bit rate switch, error state, length code, length, data). Ids that end in x have 29 bits.
"""

import re
from itertools import pairwise

from estimator.can_io.frames import FD_BYTES
from estimator.can_io.logs.line_layout import MAX_EXTENDED_ID, MAX_STANDARD_ID, NOTHING, Layout

_TIME = rb"\s*(?P<minus>-?)(?P<seconds>\d{1,12})\.(?P<fraction>\d{1,9})\s+"
_ID = rb"(?P<id>[0-9A-Fa-f]{1,8})(?P<x>[xX]?)\s+"
_DATA = rb"(?P<data>(?:\s+[0-9A-Fa-f]{2}(?!\S))*)"
_CLASSIC = re.compile(
    _TIME + rb"(?P<channel>\d+)\s+" + _ID + rb"[TR]x\s+[dD]\s+(?P<length>[0-8])(?!\S)" + _DATA, re.ASCII
)
_FLAGS = rb"(?:(?!\d+\s)\S+\s+)?[01]\s+[01]\s+[0-9A-Fa-f]\s+"  # after a symbolic name, if there is one
_FD = re.compile(
    _TIME + rb"CANFD\s+(?P<channel>\d+)\s+[TR]x\s+" + _ID + _FLAGS + rb"(?P<length>\d{1,2})(?!\S)" + _DATA, re.ASCII
)


def layout(line: bytes) -> Layout | None:
    """Parse a line with hexadecimal numbers; None if it is not a plain data frame."""
    if not line.strip():
        return NOTHING
    match = _CLASSIC.match(line) or _FD.match(line)
    if match is None:
        return None
    length, first = int(match["length"]), match.start("data")
    columns = [first + pair.start() for pair in re.finditer(rb"\S\S", match["data"])][:length]
    steps = {b - a for a, b in pairwise(columns)} or {3}
    extended = bool(match["x"])
    largest = MAX_EXTENDED_ID if extended else MAX_STANDARD_ID
    usual = len(columns) == length <= FD_BYTES and len(steps) == 1 and int(match["id"], 16) <= largest
    if not usual or (length == 0 and match.re is _FD):
        return None
    data = range(columns[0], columns[-1] + 1, steps.pop()) if columns else range(0)
    return Layout(
        seconds=match.span("seconds"),
        fraction=match.span("fraction"),
        ident=match.span("id"),
        data=data,
        length=length,
        end=columns[-1] + 2 if columns else match.end("length"),
        extended=extended,
        largest=largest,
        channel=match["channel"],
        per_second=-1.0 if match["minus"] else 1.0,
    )

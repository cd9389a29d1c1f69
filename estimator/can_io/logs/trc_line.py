"""Layout of a line of a trace file of PEAK's PCAN-View, by the version in the header.

``   12)      1841.5  Rx     18FEF100  8  00 01 02 03 04 05 06 07`` in version 1.1, and with the columns that the header
lists ``    12   1841.500 DT 1 18FEF100 Rx -  8    00 01 02 03 04 05 06 07`` from version 2.0 on. Times are in
milliseconds; ids of more than 4 digits have 29 bits.
"""

import re
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from typing import NamedTuple

from estimator.can_io.frames import CLASSIC_BYTES, FD_BYTES
from estimator.can_io.logs.line_layout import MAX_EXTENDED_ID, MAX_STANDARD_ID, NOTHING, Layout

DAY_ZERO = datetime(1899, 12, 30, tzinfo=UTC)  # of the start time, counted in days
MAX_STANDARD_DIGITS = 4  # of an id

_NUMBER = rb"[ ]*(?P<number>\d{1,12})"
_TIME = rb"(?P<seconds>\d{1,12})(?:\.(?P<fraction>\d{1,9}))?"
_ID = rb"(?P<id>[0-9A-Fa-f]{1,8})"
_LENGTH = rb"(?P<length>\d{1,2})"
_DATA = rb"(?P<data>(?:\s+[0-9A-Fa-f]{2}(?!\S))*)\s*"
_BUS = rb"(?P<channel>\d+)"
_WAY = rb"(?:Tx|Rx)"
VERSIONS = {
    b"": (_NUMBER + rb"\)", _TIME, _ID, _LENGTH),
    b"1.1": (_NUMBER + rb"\)", _TIME, _WAY, _ID, _LENGTH),
    b"1.2": (_NUMBER + rb"\)", _TIME, _BUS, _WAY, _ID, _LENGTH),
    b"1.3": (_NUMBER + rb"\)", _TIME, _BUS, _WAY, _ID, rb"\S+", _LENGTH),
}  # the columns before the data
COLUMNS = {
    b"N": _NUMBER,
    b"O": _TIME,
    b"T": rb"(?P<type>DT|FD|FB|FE|BI)",
    b"B": _BUS,
    b"I": _ID,
    b"l": _LENGTH,
    b"L": rb"(?P<length>[0-8])",  # a code, which is the length up to 8
}  # from version 2.0 on; all others hold a word
NEEDED = {b"N", b"O", b"T", b"I", b"d"}


class Head(NamedTuple):
    """Contents of the header: pattern of the lines with data frames, and offset of their times [s]."""

    frame: re.Pattern[bytes]
    start: float


def read_head(version: bytes, start: bytes, columns: bytes) -> Head | None:
    """Read the header of a trace from the texts after its keys; None if its form is unknown."""
    first = version in (b"2.0", b"2.1") and _by_columns(columns.split(b","))
    parts = first or VERSIONS.get(version)
    if not parts:
        return None
    pattern = re.compile(rb"\s+".join(parts) + _DATA, re.ASCII)
    if version == b"":
        return Head(pattern, 0.0)
    try:
        return Head(pattern, (DAY_ZERO + timedelta(days=float(start.rstrip(b";")))).timestamp())
    except (ValueError, OverflowError):
        return None


def _by_columns(names: list[bytes]) -> tuple[bytes, ...] | None:
    """Pattern of the columns before the data; None if one is missing, or the data are not the last."""
    has_length = (b"l" in names) != (b"L" in names)
    if not has_length or not set(names) >= NEEDED or names[0] != b"N" or len(set(names)) < len(names):
        return None
    return tuple(COLUMNS.get(name, rb"\S+") for name in names[:-1]) if names[-1] == b"D" else None


def layout(line: bytes, head: Head) -> Layout | None:
    """Parse a line; None if it is not a plain data frame."""
    if not line.strip() or line.lstrip().startswith(b";"):
        return NOTHING
    match = head.frame.fullmatch(line)
    if match is None:
        return None
    length, first = int(match["length"]), match.start("data")
    columns = [first + pair.start() for pair in re.finditer(rb"\S\S", match["data"])]
    steps = {b - a for a, b in pairwise(columns)} or {3}
    extended = len(match["id"]) > MAX_STANDARD_DIGITS
    largest = MAX_EXTENDED_ID if extended else MAX_STANDARD_ID
    most = FD_BYTES if "type" in match.re.groupindex and match["type"] != b"DT" else CLASSIC_BYTES
    if len(columns) != length or length > most or len(steps) > 1 or int(match["id"], 16) > largest:
        return None
    fraction = match.span("fraction") if match["fraction"] else (match.end("seconds"),) * 2
    return Layout(
        seconds=match.span("seconds"),
        fraction=fraction,
        ident=match.span("id"),
        data=range(columns[0], columns[-1] + 1, steps.pop()) if columns else range(0),
        length=length,
        end=len(line),
        extended=extended,
        largest=largest,
        number=(0, match.end("number")),
        channel=match["channel"] if "channel" in match.re.groupindex else b"",
    )

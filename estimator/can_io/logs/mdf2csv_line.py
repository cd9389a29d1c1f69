"""Layout of a line of a table of frames, as CSS Electronics' mdf2csv makes it from the logs of a CANedge.

``1700000000.100000;1;18FEF100;1;8;8;0;0;0;F3032800000000FF``, with the columns that the header names: time [s], bus
channel, id, whether it has 29 bits, length code, length, direction, flags, data.
"""

import re

from estimator.can_io.frames import FD_BYTES
from estimator.can_io.logs.line_layout import MAX_EXTENDED_ID, MAX_STANDARD_ID, NOTHING, BadLineError, Layout, shown

COLUMNS = {
    b"TimestampEpoch": rb"(?P<seconds>\d{1,12})\.(?P<fraction>\d{1,9})",
    b"BusChannel": rb"(?P<channel>\d{1,3})",
    b"ID": rb"(?P<id>[0-9A-Fa-f]{1,8})",
    b"IDE": rb"(?P<extended>[01])",
    b"DataLength": rb"(?P<length>\d{1,2})",
    b"RTR": rb"(?P<remote>[01])",
    b"DataBytes": rb"(?P<data>(?:[0-9A-Fa-f]{2})*)",
}
OTHER = rb"[^;,]*"
NEEDED = {b"TimestampEpoch", b"ID", b"IDE", b"DataLength", b"DataBytes"}
MAX_COLUMNS = 30


def pattern(header: bytes) -> re.Pattern[bytes] | None:
    """Pattern of the lines after a header; None if the header is not of this format."""
    separator = b";" if b";" in header else b","
    names = header.strip().split(separator)
    if not set(names) >= NEEDED or len(set(names)) < len(names) or len(names) > MAX_COLUMNS:
        return None
    return re.compile(separator.join(COLUMNS.get(name, OTHER) for name in names) + rb"\r?")


def layout(line: bytes, frame: re.Pattern[bytes]) -> Layout:
    """Parse a line, given the pattern of those with a frame.

    Raises
    ------
    BadLineError
        The line is neither blank nor a frame.
    """
    if not line.strip():
        return NOTHING
    match = frame.fullmatch(line)
    if match is None:
        raise BadLineError(f"expected a frame as mdf2csv writes it, found {shown(line)}")
    values = match.groupdict()
    length, first = int(match["length"]), match.start("data")
    remote = values.get("remote") == b"1"
    if not remote and not 2 * length == len(match["data"]) <= 2 * FD_BYTES:
        raise BadLineError(f"expected {length} data bytes, found {len(match['data']) // 2}")
    extended = match["extended"] == b"1"
    largest = MAX_EXTENDED_ID if extended else MAX_STANDARD_ID
    if int(match["id"], 16) > largest:
        raise BadLineError(f"expected an id of {29 if extended else 11} bits, found {match['id'].decode()}")
    length = 0 if remote else length
    return Layout(
        seconds=match.span("seconds"),
        fraction=match.span("fraction"),
        ident=match.span("id"),
        data=range(first, first + 2 * length, 2),
        length=length,
        end=len(line),
        extended=extended,
        largest=largest,
        remote=remote,
        channel=values.get("channel") or b"",
    )

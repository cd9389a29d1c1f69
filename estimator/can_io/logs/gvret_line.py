"""Layout of a line of a GVRET table, as SavvyCAN and GVRET firmware write it.

``166064000,18FEF100,true,Rx,0,8,F3,00,28,00,00,00,00,FF,``: time in microseconds, which may be below zero, id, whether
it has 29 bits, direction (older tables have none), bus, length, data.
"""

import re

from estimator.can_io.frames import FD_BYTES
from estimator.can_io.logs.line_layout import MAX_EXTENDED_ID, MAX_STANDARD_ID, NOTHING, BadLineError, Layout, shown

HEADER = re.compile(rb"\s*Time ?Stamp,ID,Extended,(?:Dir,)?Bus,LEN(?:,D\d+)*,*\s*", re.IGNORECASE)
MICROSECONDS = 1e6  # in a second

_LINE = re.compile(
    rb"(?P<minus>-?)(?P<seconds>\d{1,18}),(?:0x)?(?P<id>[0-9A-Fa-f]{1,8}),(?P<extended>true|false|[01]),"
    rb"(?:[RT]x,)?(?P<channel>\d{1,3}),(?P<length>\d{1,2})(?P<data>(?:,[0-9A-Fa-f]{2})*)[,\s]*",
    re.IGNORECASE,
)


def layout(line: bytes) -> Layout:
    """Parse a line.

    Raises
    ------
    BadLineError
        The line is neither blank nor a frame.
    """
    if not line.strip(b", \r"):
        return NOTHING
    match = _LINE.fullmatch(line)
    if match is None:
        raise BadLineError(f"expected a frame as SavvyCAN writes it, found {shown(line)}")
    length, first = int(match["length"]), match.start("data") + 1
    if length > min(FD_BYTES, len(match["data"]) // 3):
        raise BadLineError(f"expected {length} data bytes, found {len(match['data']) // 3}")
    extended = match["extended"].lower() in (b"true", b"1")
    largest = MAX_EXTENDED_ID if extended else MAX_STANDARD_ID
    if int(match["id"], 16) > largest:
        raise BadLineError(f"expected an id of {29 if extended else 11} bits, found {match['id'].decode()}")
    end = match.end("seconds")
    return Layout(
        seconds=match.span("seconds"),
        fraction=(end, end),
        ident=match.span("id"),
        data=range(first, first + 3 * length, 3),
        length=length,
        end=first + 3 * length - 1,
        extended=extended,
        largest=largest,
        channel=match["channel"],
        per_second=-MICROSECONDS if match["minus"] else MICROSECONDS,
    )

"""Logs of the Open Vehicle Monitoring System (OVMS), with one typed record a line.

``1542473901.040305 1R29 18FEF100 f3 00 28 00 00 00 00 ff``: time [s], bus (older logs have none) and type, id, data.
R and T are frames received and sent, with 11 or 29 bits in their ids; types that begin with C are comments and events.
"""

import re

from estimator.can_io.frames import CLASSIC_BYTES
from estimator.can_io.logs.line_layout import MAX_EXTENDED_ID, MAX_STANDARD_ID, NOTHING, BadLineError, Layout, shown
from estimator.can_io.logs.line_log import LineLog

_TIME = rb"\s*(?P<seconds>\d{1,12})\.(?P<fraction>\d{1,9})\s+(?P<channel>\d?)"
_FRAME = re.compile(_TIME + rb"[RT](?P<bits>11|29)\s+(?P<id>[0-9A-Fa-f]{1,8})(?P<data>(?: [0-9A-Fa-f]{2})*)\s*")
_OTHER = re.compile(_TIME + rb"C[A-Z]{2}(?:\s.*)?", re.DOTALL)


class CrtdLog(LineLog):
    """Log in ``.crtd`` format."""

    def _layout(self, line: bytes) -> Layout:
        return layout(line)


def layout(line: bytes) -> Layout:
    """Parse a line.

    Raises
    ------
    BadLineError
        The line is neither blank nor a record.
    """
    if not line.strip() or _OTHER.fullmatch(line):
        return NOTHING
    match = _FRAME.fullmatch(line)
    if match is None:
        raise BadLineError(f"expected a record as OVMS writes it, found {shown(line)}")
    length, first = len(match["data"]) // 3, match.start("data") + 1
    extended = match["bits"] == b"29"
    largest = MAX_EXTENDED_ID if extended else MAX_STANDARD_ID
    if length > CLASSIC_BYTES:
        raise BadLineError(f"expected at most {CLASSIC_BYTES} data bytes, found {length}")
    if int(match["id"], 16) > largest:
        raise BadLineError(f"expected an id of {match['bits'].decode()} bits, found {match['id'].decode()}")
    return Layout(
        seconds=match.span("seconds"),
        fraction=match.span("fraction"),
        ident=match.span("id"),
        data=range(first, first + 3 * length, 3),
        length=length,
        end=match.end("data"),
        extended=extended,
        largest=largest,
        channel=match["channel"],
    )

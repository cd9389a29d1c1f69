"""Layout of the values in a line of a text log, as a grammar finds it."""

from enum import Enum
from typing import NamedTuple

MAX_STANDARD_ID = 0x7FF
MAX_EXTENDED_ID = 0x1FFFFFFF
ERROR_FLAG = 0x20000000  # in an id, as SocketCAN writes those of error frames
SHOWN = 60  # characters of a wrong line that a message quotes


CORRECT = "correct or delete the line"


class BadLineError(ValueError):
    """Raised for a line that is not of the format; the message says what was expected, ``remedy`` what to do."""

    def __init__(self, reason: str, remedy: str = CORRECT) -> None:
        super().__init__(reason)
        self.remedy = remedy


class Coding(Enum):
    """Encoding of the payload."""

    HEX = 2  # columns a byte
    BASE64 = 4  # columns three bytes


class Layout(NamedTuple):
    """Columns of the values in a line.

    ``seconds``, ``fraction`` and ``ident`` are (first, end) columns. ``data`` are the first columns of the bytes of the
    payload, or of its groups of four in base64; ``length`` is its size [bytes]. ``largest`` is the largest valid id.
    Lines that equal this one outside their values, up to the column ``end``, have the same layout. ``number`` are the
    columns of an unused number and of the spaces before it. ``channel`` is the name of the channel, empty if there is
    none. The time is ``offset`` [s] plus the number / ``per_second``, which is negative after a minus sign.
    """

    seconds: tuple[int, int]
    fraction: tuple[int, int]
    ident: tuple[int, int]
    data: range
    length: int
    end: int
    extended: bool
    largest: int
    remote: bool = False
    coding: Coding = Coding.HEX
    number: tuple[int, int] = (0, 0)
    channel: bytes = b""
    per_second: float = 1.0
    offset: float = 0.0


NOTHING = Layout((0, 0), (0, 0), (0, 0), range(0), 0, 0, extended=False, largest=0)  # a line without a frame


def shown(line: bytes) -> str:
    """Beginning of a line, for an error message."""
    return repr(line.strip()[:SHOWN].decode("ascii", "replace"))

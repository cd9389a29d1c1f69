"""Where the values stand in a line of a text log, as a grammar finds them."""

from enum import Enum
from typing import NamedTuple

MAX_STANDARD_ID = 0x7FF
MAX_EXTENDED_ID = 0x1FFFFFFF
ERROR_FLAG = 0x20000000  # in an id, as SocketCAN writes those of error frames
SHOWN = 60  # characters of a wrong line that a message quotes


CORRECT = "correct or delete the line"


class BadLineError(ValueError):
    """A line is not of the format; the message says what was expected, ``remedy`` what to do."""

    def __init__(self, reason: str, remedy: str = CORRECT) -> None:
        super().__init__(reason)
        self.remedy = remedy


class Coding(Enum):
    """How the payload is written."""

    HEX = 2  # columns a byte
    BASE64 = 4  # columns three bytes


class Layout(NamedTuple):
    """Where the values stand in a line, as columns.

    ``seconds``, ``fraction`` and ``ident`` are (first, end) columns; ``data`` are the first columns of the payload's
    bytes, or of its groups of four where it is base64; ``length`` is that of the payload [bytes]. ``largest`` bounds
    the id. Lines that equal this one outside their values up to the column ``end`` have the same layout.
    ``number`` are the columns of a number that is of no interest, and of spaces before it. ``channel`` is the name of
    the channel, empty where the line has none. Times are ``offset`` [s] and the number over ``per_second``, which is
    below zero where the line has a minus before the number.
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
    """The beginning of a line, for a message."""
    return repr(line.strip()[:SHOWN].decode("ascii", "replace"))

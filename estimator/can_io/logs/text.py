"""Text logs that a reader of python-can takes line by line."""

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from string import hexdigits

import can

from estimator.can_io.frames import Frames
from estimator.can_io.logs.messages import MessageLog
from estimator.can_io.logs.source import Source
from estimator.can_io.logs.tap import Tap
from estimator.errors import LogError

READER_ERRORS = (ValueError, IndexError, KeyError, TypeError, OverflowError, NotImplementedError)  # on bad text
CUT = "the file ends inside this line; end it with a line break if it is whole"


class TextLog(MessageLog):
    """A text log; a subclass says which reader, and what lines without a message mean."""

    def _read(self) -> Iterator[Frames]:
        with Source(self.path) as source, Tap(source.stream, self._prepare, self._unread) as tap:
            try:
                for frames in self._pack(self._messages(tap)):
                    self.progress = source.consumed
                    yield frames
            except READER_ERRORS as error:
                reason = " ".join(str(error).split()) or type(error).__name__
                raise LogError(
                    f"{self.path}:{tap.number}: this line cannot be read ({reason}); correct or delete it"
                ) from error

    def _messages(self, tap: Tap) -> Iterator[can.Message]:
        for message in self._reader(tap):
            if is_digit_missing(tap.line, message.data):
                raise ValueError(CUT)
            tap.answered()
            yield message

    @abstractmethod
    def _reader(self, tap: Tap) -> Iterable[can.Message]:
        """Start python-can's reader on the lines of ``tap``."""

    def _prepare(self, line: str) -> list[str]:
        """Give the lines that the reader shall see for a line of the file."""
        return [line]

    def _unread(self, line: str) -> None:
        """Count a line that gave no message, or raise ValueError if it should have."""
        raise ValueError(f"expected a frame, found {line.strip()[:60]!r}")


def is_digit_missing(line: str, data: bytearray, digits: int = 2, base: int = 16) -> bool:
    """Whether a line has no line break and ends in its last payload byte, with fewer digits than bytes have."""
    last = line.split()[-1]
    short = not line.endswith("\n") and len(last) < digits and all(digit in hexdigits for digit in last)
    return short and len(data) > 0 and int(last, base) == data[-1]

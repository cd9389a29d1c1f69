"""Text logs with a frame a line: what candump, .asc and .csv have in common.

A grammar finds where the values stand in a line, and many lines of one layout are converted at once. Lines that the
grammar leaves open go one by one through the reader of python-can.
"""

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator
from io import BufferedReader, BytesIO
from pathlib import Path

import can
import numpy as np

from estimator.can_io.frames import Frames
from estimator.can_io.logs.channels import UNNAMED
from estimator.can_io.logs.line_layout import BadLineError, Layout, shown
from estimator.can_io.logs.line_table import Lines, Usual
from estimator.can_io.logs.log import Log
from estimator.can_io.logs.messages import check_message, kind_of
from estimator.can_io.logs.source import Source
from estimator.can_io.logs.tap import MAX_IDLE, MAX_LINE, Tap
from estimator.can_io.logs.text import CUT, READER_ERRORS, is_digit_missing
from estimator.errors import LogError

CHUNK = 1 << 19  # bytes read at once; what is made of more does not fit a processor's cache
MAX_LINES = 1 << 16  # parsed at once: more of them in a chunk are no traffic, but would take memory
BYTE_ORDER_MARK = b"\xef\xbb\xbf"
Reader = Callable[[Tap], Iterable[can.Message]]


class LineLog(Log):
    """A text log; a subclass gives the grammar of its lines, and treats those that it leaves open."""

    byte_digits, byte_base = 2, 16  # how a payload byte is written
    usual: Usual | None = None  # reads usual lines faster than by the grammar

    def __init__(self, path: Path, channels: Iterable[str] = ()) -> None:
        super().__init__(path, channels)
        self._number = 1  # of the first line that has not been parsed
        self._last_frame = 0  # number of the last line up to which there was a frame

    def _read(self) -> Iterator[Frames]:
        self._number, self._last_frame = 1, 0
        self._begin()
        with Source(self.path) as source:
            rest = source.read(len(BYTE_ORDER_MARK)).removeprefix(BYTE_ORDER_MARK)
            while piece := source.read(CHUNK):
                text = rest + piece
                end = text.rfind(b"\n") + 1
                self.progress = source.consumed
                for part in _parts(text[:end]):
                    yield from self._parse(part)
                rest = text[end:]
                if len(rest) > MAX_LINE:
                    break  # no line, as is found below
            yield from self._parse(rest)

    def _begin(self) -> None:
        """Prepare for the first line."""

    def _after_header(self, text: bytes) -> bytes:
        """Take what stands before the lines of traffic from the beginning of the file."""
        return text

    @abstractmethod
    def _layout(self, line: bytes) -> Layout | None:
        """Parse a line; None leaves it to `_settle`."""

    def _settle(self, lines: Lines, ended: bool) -> None:
        """Treat the lines that the grammar leaves open; ``ended`` is whether the last one has its line break."""

    def _reader_head(self) -> bytes:
        """Give the lines that the reader of python-can wants before any other."""
        return b""

    def _channel_of(self, message: can.Message) -> str:
        """The channel of a message of python-can, as the log names it."""
        return UNNAMED

    def _unread(self, line: str) -> None:
        """Count a line of which python-can makes no message, or raise ValueError if it should."""
        raise ValueError(f"expected a frame, found {shown(line.encode())}")

    def _parse(self, text: bytes) -> Iterator[Frames]:
        """Yield the frames of whole lines; only the last line of the file may lack its line break."""
        text = self._after_header(text)
        if not text:
            return
        ended = text.endswith(b"\n")
        lines = Lines(text if ended else text + b"\n", self._checked_layout, self.usual)
        self._settle(lines, ended)
        frames, channel, skipped = lines.frames()
        self.skipped.update(skipped)
        yield self.channels.keep(frames, channel, lines.channels.__getitem__)
        if lines.bad is not None:
            row, error = lines.bad
            if ended or row + 1 < len(lines):
                raise LogError(f"{self.path}:{self._number + row}: {error}; correct or delete the line")
            raise LogError(
                f"{self.path}:{self._number + row}: the file ends inside this line ({error}); "
                "delete the line, or end it with a line break if it is whole"
            )
        self._number += len(lines)
        if len(frames):
            self._last_frame = self._number
        else:
            self._check_idle()

    def _check_idle(self) -> None:
        if self._number - self._last_frame > MAX_IDLE:
            found = f"expected a frame, found {MAX_IDLE:,} lines without"
            raise LogError(f"{self.path}:{self._number}: {found}; give another log")

    def _checked_layout(self, line: bytes) -> Layout | None:
        if len(line) > MAX_LINE:
            raise BadLineError(f"expected a frame, found a line of over {MAX_LINE} bytes")
        return self._layout(line)

    def _hand_over(self, lines: Lines, rows: list[int], ended: bool, reader: Reader) -> None:
        """Have the ``reader`` of python-can parse some lines."""
        if not rows:
            return
        head = self._reader_head()
        # A carriage return inside a line would be the end of a line to python-can.
        text = head + b"".join(lines.line(row).rstrip(b"\r").replace(b"\r", b" ") + b"\n" for row in rows)
        if not ended and rows[-1:] == [len(lines) - 1]:
            text = text[:-1]
        before = head.count(b"\n")
        with Tap(BufferedReader(BytesIO(text)), lambda line: [line], self._unread) as tap:
            try:
                for message in reader(tap):
                    if is_digit_missing(tap.line, message.data, self.byte_digits, self.byte_base):
                        raise ValueError(CUT)
                    tap.answered()
                    kind = kind_of(message)
                    if not kind:
                        check_message(message)
                    row = rows[tap.number - before - 1]
                    lines.put(row, Frames.from_messages([message]), kind, self._channel_of(message))
            except READER_ERRORS as error:
                reason = " ".join(str(error).split()) or type(error).__name__
                place = min(max(tap.number - before, 1), len(rows)) - 1  # the text may hold more line ends than rows
                lines.refuse(rows[place], f"this line cannot be read ({reason})")


def line_from(text: bytes, start: int) -> tuple[bytes, int]:
    """The line that begins at ``start``, without its line break, and where the next one begins."""
    end = text.find(b"\n", start)
    return (text[start:], len(text)) if end < 0 else (text[start:end], end + 1)


def _parts(text: bytes) -> Iterator[bytes]:
    """Whole lines, at most MAX_LINES at a time."""
    if text.count(b"\n") <= MAX_LINES:
        yield text
        return
    ends = np.flatnonzero(np.frombuffer(text, np.uint8) == ord("\n"))[MAX_LINES - 1 :: MAX_LINES] + 1
    start = 0
    for end in (*ends.tolist(), len(text)):
        yield text[start:end]
        start = end

"""Text logs with one frame a line: base of the readers of candump, .asc, .csv and others.

A grammar finds the layout of a line, and many lines of one layout are converted together. Lines that the grammar leaves
open are parsed one by one by the reader of python-can. A few unreadable lines are skipped and counted: a logger that
lost power cuts a line or leaves a block of zeros.
"""

import codecs
import re
from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator
from io import BufferedReader, BytesIO
from pathlib import Path

import can
import numpy as np

from estimator.can_io.frames import Frames
from estimator.can_io.logs.channels import UNNAMED
from estimator.can_io.logs.line_layout import BadLineError, Layout, shown
from estimator.can_io.logs.line_table import MAX_BAD, Lines, Usual
from estimator.can_io.logs.log import Log
from estimator.can_io.logs.messages import check_message, kind_of
from estimator.can_io.logs.source import Source
from estimator.can_io.logs.tap import MAX_IDLE, MAX_LINE, Tap
from estimator.can_io.logs.text import CUT, READER_ERRORS, is_digit_missing
from estimator.errors import LogError

CHUNK = 1 << 19  # bytes read at once; what is made of more does not fit a processor's cache
MAX_LINES = 1 << 16  # parsed at once: more of them in a chunk are no traffic, but would take memory
BYTE_ORDER_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
MIN_DAMAGED, DAMAGED_SHARE = 3, 0.01  # lines that may be damaged: so many, and this share of the lines before
ZEROS = re.compile(rb"\0+")  # what a logger that lost power leaves
COLOUR = re.compile(rb"\x1b\[[0-9;]*m")
Reader = Callable[[Tap], Iterable[can.Message]]


class LineLog(Log):
    """Text log; a subclass has the grammar of its lines, and processes the lines that it leaves open."""

    byte_digits, byte_base = 2, 16  # how a payload byte is written
    usual: Usual | None = None  # reads usual lines faster than by the grammar

    def __init__(self, path: Path, channels: Iterable[str] = ()) -> None:
        super().__init__(path, channels)
        self._number = 1  # of the first line that has not been parsed
        self._last_frame = 0  # number of the last line up to which there was a frame
        self._frames = 0
        self._damaged: list[int] = []  # numbers of the lines that could not be read

    def _read(self) -> Iterator[Frames]:
        self._number, self._last_frame, self._frames, self._damaged = 1, 0, 0, []
        self._begin()
        rest = b""
        with Source(self.path) as source:
            for piece in _pieces(source):
                text = rest + piece
                if b"\0" in text:
                    text = ZEROS.sub(b"\0", text)
                end = text.rfind(b"\n") + 1
                self.progress = source.consumed
                for part in _parts(text[:end]):
                    yield from self._parse(part)
                rest = text[end:]
                if len(rest) > MAX_LINE:
                    error = f"expected a frame, found a line of over {MAX_LINE} bytes"
                    raise LogError(f"{self.path}:{self._number}: {error}; give another log")
            yield from self._parse(rest)
        if self._damaged:
            self.skipped[f"damaged line (the first is line {self._damaged[0]})"] += len(self._damaged)

    def _begin(self) -> None:
        """Prepare a pass over the log."""

    def _after_header(self, text: bytes) -> bytes:
        """Read the header from the beginning of the file; returns the lines of traffic after it."""
        return text

    @abstractmethod
    def _layout(self, line: bytes) -> Layout | None:
        """Parse a line; None leaves it to `_settle`."""

    def _settle(self, lines: Lines, ended: bool) -> None:
        """Process the lines that the grammar leaves open; ``ended`` is True if the last one has its line break."""

    def _cleaned(self, text: bytes) -> bytes:
        """Remove characters that a terminal added to lines."""
        return COLOUR.sub(b"", text) if b"\x1b" in text else text

    def _reader_head(self) -> bytes:
        """Header lines that the reader of python-can needs."""
        return b""

    def _channel_of(self, message: can.Message) -> str:
        """Channel of a message of python-can, as the log names it."""
        return UNNAMED

    def _unread(self, line: str) -> None:
        """Count a line from which python-can makes no message, or raise ValueError if it should make one."""
        raise ValueError(f"expected a frame, found {shown(line.encode())}")

    def _parse(self, text: bytes) -> Iterator[Frames]:
        """Yield the frames of whole lines; only the last line of the file may lack its line break."""
        text = self._after_header(self._cleaned(text))
        if not text:
            return
        ended = text.endswith(b"\n")
        lines = Lines(text if ended else text + b"\n", self._checked_layout, self.usual)
        self._settle(lines, ended)
        frames, channel, skipped = lines.frames()
        is_refused = lines.bad and not self._is_damage(len(lines.bad), len(lines), len(frames))
        if is_refused:
            frames, channel, skipped = lines.frames(min(lines.bad))
        self.skipped.update(skipped)
        yield self.channels.keep(frames, channel, lines.channels.__getitem__)
        if is_refused:
            raise self._refusal(min(lines.bad), lines, ended)
        self._frames += len(frames)
        self._damaged += [self._number + row for row in sorted(lines.bad)]
        self._number += len(lines)
        if len(frames):
            self._last_frame = self._number
        else:
            self._check_idle()

    def _is_damage(self, bad: int, lines: int, frames: int) -> bool:
        """True if bad lines are so few among those with frames that the log is damaged, not of another format."""
        bad += len(self._damaged)
        most = MIN_DAMAGED + DAMAGED_SHARE * (self._number + lines)
        return bad <= min(most, self._frames + frames) and bad - len(self._damaged) <= MAX_BAD

    def _refusal(self, row: int, lines: Lines, ended: bool) -> LogError:
        where, error = f"{self.path}:{self._number + row}", lines.bad[row]
        if not ended and row + 1 == len(lines):
            return LogError(
                f"{where}: the file ends inside this line ({error}); "
                "delete the line, or end it with a line break if it is whole"
            )
        if self._damaged:
            return LogError(f"{where}: {error}; {len(self._damaged)} lines before it could not be read either")
        return LogError(f"{where}: {error}; {error.remedy}")

    def _check_idle(self) -> None:
        if self._number - self._last_frame > MAX_IDLE:
            error = f"expected a frame, found {MAX_IDLE:,} lines without"
            raise LogError(f"{self.path}:{self._number}: {error}; give another log")

    def _checked_layout(self, line: bytes) -> Layout | None:
        if len(line) > MAX_LINE:
            raise BadLineError(f"expected a frame, found a line of over {MAX_LINE} bytes")
        return self._layout(line)

    def _hand_over(self, lines: Lines, rows: list[int], ended: bool, reader: Reader) -> None:
        """Parse lines by the ``reader`` of python-can."""
        most = len(lines.bad) + MAX_BAD
        while rows and len(lines.bad) <= most:
            rows = self._hand_over_up_to_bad(lines, rows, ended, reader)

    def _hand_over_up_to_bad(self, lines: Lines, rows: list[int], ended: bool, reader: Reader) -> list[int]:
        """Parse lines up to the first bad one; the rows after it are left."""
        head = self._reader_head()
        # A carriage return inside a line would be the end of a line to python-can.
        text = head + b"".join(lines.line(row).rstrip(b"\r").replace(b"\r", b" ") + b"\n" for row in rows)
        if not ended and rows[-1:] == [len(lines) - 1]:
            text = text[:-1]
        head_lines = head.count(b"\n")
        with Tap(BufferedReader(BytesIO(text)), lambda line: [line], self._unread) as tap:
            try:
                for message in reader(tap):
                    if is_digit_missing(tap.line, message.data, self.byte_digits, self.byte_base):
                        raise ValueError(CUT)
                    tap.answered()
                    kind = kind_of(message)
                    if not kind:
                        check_message(message)
                    row = rows[tap.number - head_lines - 1]
                    lines.put(row, Frames.from_messages([message]), kind, self._channel_of(message))
            except READER_ERRORS as error:
                reason = " ".join(str(error).split()) or type(error).__name__
                # The text may hold more line ends than rows.
                bad = min(max(tap.number - head_lines, 1), len(rows)) - 1
                lines.refuse(rows[bad], f"this line cannot be read ({reason})")
                return rows[bad + 1 :]
        return []


def line_from(text: bytes, start: int) -> tuple[bytes, int]:
    """Line that begins at ``start``, without its line break, and the start of the next line."""
    end = text.find(b"\n", start)
    return (text[start:], len(text)) if end < 0 else (text[start:end], end + 1)


def _pieces(source: Source) -> Iterator[bytes]:
    """Yield the text of a log in pieces, as UTF-8 without a byte order mark."""
    start = source.read(len(codecs.BOM_UTF8))
    if not start.startswith(BYTE_ORDER_MARKS):
        yield start.removeprefix(codecs.BOM_UTF8)
        while piece := source.read(CHUNK):
            yield piece
        return
    decoder = codecs.getincrementaldecoder("utf-16")("replace")
    while start:
        yield decoder.decode(start).encode()
        start = source.read(CHUNK)
    yield decoder.decode(b"", final=True).encode()


def _parts(text: bytes) -> Iterator[bytes]:
    """Yield whole lines, at most MAX_LINES at a time."""
    if text.count(b"\n") <= MAX_LINES:
        yield text
        return
    ends = np.flatnonzero(np.frombuffer(text, np.uint8) == ord("\n"))[MAX_LINES - 1 :: MAX_LINES] + 1
    start = 0
    for end in (*ends.tolist(), len(text)):
        yield text[start:end]
        start = end

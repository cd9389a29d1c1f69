"""Logs of SocketCAN's candump, in the form of ``candump -l`` or copied from its screen output."""

from collections.abc import Iterator

from estimator.can_io.frames import Frames
from estimator.can_io.logs.candump_line import MAX_LINE, SHOWN, BadLineError, layout
from estimator.can_io.logs.candump_text import parse_lines
from estimator.can_io.logs.log import Log
from estimator.can_io.logs.source import Source
from estimator.errors import LogError

CHUNK = 1 << 19  # bytes read at once


class CandumpLog(Log):
    """A ``.log`` file of candump."""

    def _read(self) -> Iterator[Frames]:
        with Source(self.path) as source:
            number = 1  # of the first line in `text`
            rest = b""
            while piece := source.read(CHUNK):
                text = rest + piece
                end = text.rfind(b"\n") + 1
                text, rest = text[:end], text[end:]
                yield from self._parse(text, number)
                number += text.count(b"\n")
                self.progress = source.consumed
                if len(rest) > MAX_LINE:
                    break  # no line: the check below says so
            if rest:
                self._check_last(rest, number)
                yield from self._parse(rest + b"\n", number)

    def _parse(self, text: bytes, number: int) -> Iterator[Frames]:
        """Yield the frames of whole lines; the first of them is line ``number``."""
        frames, skipped, bad = parse_lines(text)
        self.skipped.update(skipped)
        yield frames
        if bad is not None:
            line, reason = bad
            raise LogError(f"{self.path}:{number + line}: {reason}; correct or delete the line")

    def _check_last(self, line: bytes, number: int) -> None:
        """Refuse a line without newline, unless nothing can be missing from it."""
        try:
            complete = layout(line).tail
        except BadLineError:
            complete = False
        if not complete:
            shown = line.strip()[:SHOWN].decode("ascii", "replace")
            raise LogError(
                f"{self.path}:{number}: the file ends inside this line, {shown!r}; "
                "delete the line, or end it with a newline if it is whole"
            )

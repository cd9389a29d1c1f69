"""Monitoring of the lines of a text log that a reader of python-can parses.

The readers of python-can ignore lines that they do not know, and their errors name no line. A tap knows the line that
the reader is parsing, and reports each line without a message.
"""

from collections import deque
from collections.abc import Callable
from io import BufferedReader, TextIOWrapper
from typing import Any

MAX_LINE = 16_384  # characters; what goes on longer without a newline is no text
MAX_IDLE = 1_000_000  # lines one after another without a frame; no logger writes as many


class Tap(TextIOWrapper):
    """Text file that passes each line through ``prepare``, and reports lines without a message to ``unread``.

    ``prepare`` returns the lines that the reader gets instead; the last of them represents the line of the file. Blank
    lines are left out. ``number`` and ``line`` are those of the line that the reader is parsing.
    """

    def __init__(
        self, stream: "BufferedReader[Any]", prepare: Callable[[str], list[str]], unread: Callable[[str], None]
    ) -> None:
        super().__init__(stream, encoding="utf-8-sig", errors="replace")
        self._prepare = prepare
        self._unread = unread
        self._waiting: deque[str] = deque()
        self._answered = True
        self._last_frame = 0  # number of the last line that gave a message
        self.number = 0
        self.line = ""

    def answered(self) -> None:
        """Note that the reader has made a message from the present line."""
        self._answered = True
        self._last_frame = self.number

    def __next__(self) -> str:  # type: ignore[override]  # as in typeshed's own TextIOWrapper
        if not self._waiting:
            if not self._answered:
                self._unread(self.line)
            self._advance()
            self._waiting.extend(self._prepare(self.line))
        self._answered = len(self._waiting) > 1
        return self._waiting.popleft()

    def _advance(self) -> None:
        self.line = "\n"
        while not self.line.strip():
            if self.number - self._last_frame > MAX_IDLE:
                raise ValueError(f"expected a frame, found {MAX_IDLE:,} lines without")
            self.line = self.readline(MAX_LINE)
            if not self.line:
                self._answered = True
                raise StopIteration
            self.number += 1
        if len(self.line) == MAX_LINE:
            raise ValueError(f"expected text, found a line of over {MAX_LINE} characters")

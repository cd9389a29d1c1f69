"""Trace files of PEAK's PCAN-View."""

import re

import can

from estimator.can_io.logs.channels import UNNAMED
from estimator.can_io.logs.line_layout import Layout, shown
from estimator.can_io.logs.line_log import LineLog, line_from
from estimator.can_io.logs.line_table import Lines
from estimator.can_io.logs.log import ERROR_FRAME
from estimator.can_io.logs.trc_line import layout, read_head
from estimator.errors import LogError

OTHERS = {
    "ER": ERROR_FRAME,
    "Error": ERROR_FRAME,
    "EC": "error counter line",
    "EV": "event line",
    "ST": "status line",
    "Warng": "status line",
    "FFFFFFFF": "status line",
}  # by the word that stands for the type of the line, or in version 1.0 for the id
FIRST = re.compile(rb"\s*\d+\)")  # what a line of version 1.0 begins with, whose header may have no keys
KEYS = (b";$FILEVERSION", b";$STARTTIME", b";$COLUMNS")
MILLISECONDS = 1000  # in a second


class TrcLog(LineLog):
    """Log in ``.trc`` format; times are those of python-can, counted from the start time in the header."""

    def _begin(self) -> None:
        self._keys: dict[bytes, bytes] = {}  # the lines of the header that say something
        self._in_header = True

    def _after_header(self, text: bytes) -> bytes:
        start = 0
        while start < len(text) and self._in_header:
            line, after = line_from(text, start)
            if line.strip() and not line.lstrip().startswith(b";"):
                self._in_header = False
                if KEYS[0] not in self._keys and FIRST.match(line) is None:
                    error = f"expected a trace of PEAK's PCAN-View with a line ;$FILEVERSION, found {shown(line)}"
                    raise LogError(f"{self.path}:{self._number}: {error}; export it as .asc or .blf")
                self._head = read_head(*(self._keys.get(key, b"").partition(b"=")[2] for key in KEYS))
                break
            self._keys |= {key: line.strip() for key in KEYS if line.strip().startswith(key)}
            self._number += 1
            self._check_idle()
            start = after
        return text[start:]

    def _layout(self, line: bytes) -> Layout | None:
        return None if self._head is None else layout(line, self._head)

    def _settle(self, lines: Lines, ended: bool) -> None:
        if self._head is not None:
            lines.t /= MILLISECONDS
            lines.t += self._head.start
        others = []
        for row in sorted(lines.odd):
            if lines.line(row).split(maxsplit=5)[4:5] == [b"ERROR"]:  # of version 1.0, which python-can refuses
                self.skipped[ERROR_FRAME] += 1
            else:
                others.append(row)
        self._hand_over(lines, others, ended, can.TRCReader)

    def _reader_head(self) -> bytes:
        return b"".join(line + b"\n" for line in self._keys.values())

    def _channel_of(self, message: can.Message) -> str:
        is_named = self._head is None or "channel" in self._head.frame.groupindex
        return str(message.channel) if is_named else UNNAMED

    def _unread(self, line: str) -> None:
        if line.lstrip().startswith(";"):
            return
        reason = next((OTHERS[word] for word in line.split()[1:4] if word in OTHERS), None)
        if reason is None:
            super()._unread(line)
        else:
            self.skipped[reason] += 1

"""ASCII logs of Vector's CANalyzer and CANoe.

Two errors of python-can's reader are avoided here. It reads the header ``timestamps relative`` but does not add up the
times. It treats the line after a header without ``internal events logged`` as part of the header.
"""

import re

import can
import numpy as np

from estimator.can_io.logs.asc_line import layout
from estimator.can_io.logs.channels import UNNAMED
from estimator.can_io.logs.line_layout import NOTHING, Layout
from estimator.can_io.logs.line_log import LineLog, line_from
from estimator.can_io.logs.line_table import Lines
from estimator.can_io.logs.text import CUT

EVENT = re.compile(rb"\s*(?P<time>-?\d+\.\d+)\s+\S")
COMMA = re.compile(rb"^([ \t]*-?\d+),(?=\d+\s)", re.MULTILINE)  # in a time, as some countries write it
BASE = re.compile(rb"\s*base\s+(?P<base>hex|dec)(\s+timestamps\s+(?P<times>absolute|relative))?", re.IGNORECASE)
NO_EVENT = re.compile(rb"\s*(//|date |base |(no )?internal events|begin |end |previous log file)", re.IGNORECASE)
FRAME = re.compile(r"\s[TR]x\s+[dr]\b")


class AscLog(LineLog):
    """Log in ``.asc`` format; times count from the start of the measurement."""

    def _begin(self) -> None:
        self.byte_base, self.byte_digits = 16, 2
        self._before_events = True
        self._has_commas: bool | None = None  # whether times have; None until one was seen
        self._relative = False
        self._clock = 0.0  # s, the time of the last event where the log gives the steps only

    def _cleaned(self, text: bytes) -> bytes:
        text = super()._cleaned(text)
        if self._has_commas is None and (time := re.search(rb"^[ \t]*-?\d+([.,])\d+\s", text, re.MULTILINE)):
            self._has_commas = time[1] == b","
        return COMMA.sub(rb"\1.", text) if self._has_commas else text

    def _after_header(self, text: bytes) -> bytes:
        start = 0
        while start < len(text) and self._before_events:
            line, after = line_from(text, start)
            if EVENT.match(line):
                self._before_events = False
                break
            if match := BASE.match(line):
                if match["base"].lower() == b"dec":
                    self.byte_base, self.byte_digits = 10, 3
                self._relative = (match["times"] or b"").lower() == b"relative"
            self._count_no_event(line)
            self._number += 1
            self._check_idle()
            start = after
        return text[start:]

    def _count_no_event(self, line: bytes) -> None:
        if line.strip() and NO_EVENT.match(line) is None:
            self.skipped["line that is no event"] += 1

    def _layout(self, line: bytes) -> Layout | None:
        if line.startswith(b"//"):
            return NOTHING
        return layout(line) if self.byte_base == 16 else None

    def _settle(self, lines: Lines, ended: bool) -> None:
        events = []
        for row in sorted(lines.odd):
            line = lines.line(row)
            match = EVENT.match(line)
            if match is None:
                self._count_no_event(line)
            elif match["time"].startswith(b"-"):  # which python-can does not read
                self.skipped["event before the start of the measurement"] += 1
            else:
                lines.t[row] = float(match["time"])
                if b"TxRq" in line.split(maxsplit=4)[:4]:  # sent later, on a line of its own
                    self.skipped["request to transmit"] += 1
                else:
                    events.append(row)
        self._hand_over(lines, events, ended, can.ASCReader)
        if self._relative:
            lines.t[:] = np.cumsum(np.concatenate(([self._clock], lines.t)))[1:]
            self._clock = float(lines.t[-1])

    def _reader_head(self) -> bytes:
        """Header for python-can's reader that has only the base of the numbers."""
        base = b"hex" if self.byte_base == 16 else b"dec"
        return b"base " + base + b"  timestamps absolute\nno internal events logged\n"

    def _channel_of(self, message: can.Message) -> str:
        return str(message.channel + 1) if isinstance(message.channel, int) else UNNAMED  # python-can counts from 0

    def _unread(self, line: str) -> None:
        if EVENT.match(line.encode()) is None:  # of the header
            return
        if not line.endswith("\n"):
            raise ValueError(CUT)
        if "J1939TP" in line.upper().split(maxsplit=3)[1:3]:  # newer programs give the channel first
            self.skipped["J1939TP line (a transport protocol message that CANoe put together)"] += 1
        elif FRAME.search(line):
            self.skipped["frame with a symbolic name"] += 1
        elif "Start of measurement" not in line:
            self.skipped["event that is no CAN frame"] += 1

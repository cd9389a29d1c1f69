"""ASCII logs of Vector's CANalyzer and CANoe.

Two traps of python-can's reader are handled here: it reads the header ``timestamps relative`` but does not add the
times up, and it takes the line after a header without ``internal events logged`` for part of the header.
"""

import re
from collections.abc import Iterable

import can

from estimator.can_io.logs.tap import Tap
from estimator.can_io.logs.text import CUT, TextLog

EVENT = re.compile(r"\s*(?P<time>-?\d+\.\d+)\s+(?P<rest>(?P<word>\S+).*)", re.DOTALL)
RELATIVE = re.compile(r"\s*base\s+\w+\s+timestamps\s+relative", re.IGNORECASE)
HEADER_END = "no internal events logged\n"  # where python-can takes the header to end
NO_EVENT = re.compile(r"\s*(//|date |base |(no )?internal events|begin |end |previous log file)", re.IGNORECASE)
FRAME = re.compile(r"\s[TR]x\s+[dr]\b")


class AscLog(TextLog):
    """An ``.asc`` log; times count from the start of the measurement."""

    def _reader(self, tap: Tap) -> Iterable[can.Message]:
        self._in_header = True
        self._relative = False
        self._clock = 0.0  # s, the time of the last event where the log gives the steps only
        return can.ASCReader(tap)

    def _prepare(self, line: str) -> list[str]:
        event = EVENT.match(line)
        if event is None:
            self._relative = self._relative or RELATIVE.match(line) is not None
            return [line]
        if event["time"].startswith("-"):
            raise ValueError("expected a time from 0 s on, found a negative one")
        if self._relative:
            self._clock += float(event["time"])
            line = f"{self._clock:.9f} {event['rest']}"
        lines = [HEADER_END, line] if self._in_header else [line]
        self._in_header = False
        return lines

    def _unread(self, line: str) -> None:
        event = EVENT.match(line)
        if event is None:
            if NO_EVENT.match(line) is None:
                self.skipped["line that is no event"] += 1
            return
        if not line.endswith("\n"):
            raise ValueError(CUT)
        if event["word"].upper() == "J1939TP":
            self.skipped["J1939TP line (a transport protocol message that CANoe put together)"] += 1
        elif FRAME.search(line):
            self.skipped["frame with a symbolic name"] += 1
        elif not event["rest"].startswith("Start of measurement"):
            self.skipped["event that is no CAN frame"] += 1

"""Trace files of PEAK's PCAN-View."""

from collections.abc import Iterable

import can

from estimator.can_io.logs.log import ERROR_FRAME
from estimator.can_io.logs.tap import Tap
from estimator.can_io.logs.text import TextLog

OTHERS = {
    "ER": ERROR_FRAME,
    "Error": ERROR_FRAME,
    "EC": "error counter line",
    "EV": "event line",
    "ST": "status line",
    "Warng": "status line",
    "FFFFFFFF": "status line",
}  # by the word that stands for the type of the line, or in version 1.0 for the id


class TrcLog(TextLog):
    """A ``.trc`` log; times are python-can's, from the start time in the header on."""

    def _reader(self, tap: Tap) -> Iterable[can.Message]:
        return can.TRCReader(tap)

    def _unread(self, line: str) -> None:
        if line.lstrip().startswith(";"):
            return
        reason = next((OTHERS[word] for word in line.split()[1:4] if word in OTHERS), None)
        if reason is None:
            super()._unread(line)
        else:
            self.skipped[reason] += 1

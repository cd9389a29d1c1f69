"""Comma-separated logs as python-can writes them."""

from collections.abc import Iterable

import can

from estimator.can_io.logs.tap import Tap
from estimator.can_io.logs.text import TextLog

HEADER = "timestamp,arbitration_id,extended,remote,error,dlc,data"


class CsvLog(TextLog):
    """A ``.csv`` log of python-can; any other table of numbers is refused."""

    last_line_ends = False  # a cut shows in the length of the data

    def _reader(self, tap: Tap) -> Iterable[can.Message]:
        self._header_seen = False
        return can.CSVReader(tap)

    def _prepare(self, line: str) -> list[str]:
        if not self._header_seen and line.strip() != HEADER:
            raise ValueError(f"expected the header {HEADER!r} of a python-can log, found {line.strip()[:60]!r}")
        self._header_seen = True
        return [line]

    def _unread(self, line: str) -> None:
        if line.strip() != HEADER:
            super()._unread(line)

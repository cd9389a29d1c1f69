"""Comma-separated logs as python-can writes them."""

import re

import can

from estimator.can_io.frames import CLASSIC_BYTES
from estimator.can_io.logs.csv_columns import read_usual
from estimator.can_io.logs.line_layout import MAX_EXTENDED_ID, MAX_STANDARD_ID, NOTHING, Coding, Layout, shown
from estimator.can_io.logs.line_log import LineLog, line_from
from estimator.can_io.logs.line_table import Lines
from estimator.errors import LogError

HEADER = b"timestamp,arbitration_id,extended,remote,error,dlc,data"
FRAME = re.compile(
    rb"(?P<seconds>\d{1,12})\.(?P<fraction>\d{1,18}),0x(?P<id>[0-9A-Fa-f]{1,8}),(?P<extended>[01]),0,0,"
    rb"(?P<length>[0-8]),(?P<data>(?:[A-Za-z0-9+/]{4})*(?:[A-Za-z0-9+/]{3}=|[A-Za-z0-9+/]{2}==)?)\r?"
)


class CsvLog(LineLog):
    """A ``.csv`` log of python-can; any other table of numbers is refused."""

    usual = staticmethod(read_usual)

    def _begin(self) -> None:
        self._header_seen = False

    def _after_header(self, text: bytes) -> bytes:
        start = 0
        while start < len(text) and not self._header_seen:
            line, start = line_from(text, start)
            if line.strip() and line.strip() != HEADER:
                found = f"expected the header {HEADER.decode()!r} of a python-can log, found {shown(line)}"
                raise LogError(f"{self.path}:{self._number}: {found}; give another log")
            self._header_seen = line.strip() == HEADER
            self._number += 1
            self._check_idle()
        return text[start:]

    def _layout(self, line: bytes) -> Layout | None:
        if not line.strip():
            return NOTHING
        match = FRAME.fullmatch(line)
        if match is None:
            return None
        first, end = match.span("data")
        length = (end - first) // 4 * 3 - line.count(b"=", first)
        extended = match["extended"] == b"1"
        largest = MAX_EXTENDED_ID if extended else MAX_STANDARD_ID
        if length != int(match["length"]) or length > CLASSIC_BYTES or int(match["id"], 16) > largest:
            return None
        return Layout(
            seconds=match.span("seconds"),
            fraction=match.span("fraction"),
            ident=match.span("id"),
            data=range(first, end, Coding.BASE64.value),
            length=length,
            end=end,
            extended=extended,
            largest=largest,
            coding=Coding.BASE64,
        )

    def _settle(self, lines: Lines, ended: bool) -> None:
        self._hand_over(lines, sorted(lines.odd), ended, can.CSVReader)

    def _reader_head(self) -> bytes:
        return HEADER + b"\n"

    def _unread(self, line: str) -> None:
        if line.encode().strip() != HEADER:
            super()._unread(line)

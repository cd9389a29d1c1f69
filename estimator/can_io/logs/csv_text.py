"""Comma-separated logs of python-can, SavvyCAN and mdf2csv, distinguished by their header."""

import re
from functools import partial
from pathlib import Path

import can

from estimator.can_io.frames import CLASSIC_BYTES
from estimator.can_io.logs import gvret_line, mdf2csv_line
from estimator.can_io.logs.csv_columns import read_usual
from estimator.can_io.logs.line_layout import (
    MAX_EXTENDED_ID,
    MAX_STANDARD_ID,
    NOTHING,
    BadLineError,
    Coding,
    Layout,
    shown,
)
from estimator.can_io.logs.line_log import LineLog, line_from
from estimator.can_io.logs.line_table import Grammar, Lines
from estimator.can_io.logs.log import GIVE_COLUMNS
from estimator.errors import LogError

HEADER = b"timestamp,arbitration_id,extended,remote,error,dlc,data"
TABLE = re.compile(rb"[^\x00-\x1f\x7f,;\t]*(?:[,;\t][^\x00-\x1f\x7f,;\t]*)+")  # names of at least two columns
FRAME = re.compile(
    rb"(?P<seconds>\d{1,12})\.(?P<fraction>\d{1,18}),0x(?P<id>[0-9A-Fa-f]{1,8}),(?P<extended>[01]),0,0,"
    rb"(?P<length>[0-8]),(?P<data>(?:[A-Za-z0-9+/]{4})*(?:[A-Za-z0-9+/]{3}=|[A-Za-z0-9+/]{2}==)?)\r?"
)


class CsvLog(LineLog):
    """Log of frames in ``.csv`` format; any other table is refused."""

    def _begin(self) -> None:
        self._grammar: Grammar | None = None
        self.usual = None

    def _after_header(self, text: bytes) -> bytes:
        start = 0
        while start < len(text) and self._grammar is None:
            line, start = line_from(text, start)
            if line.strip():
                self._grammar = self._grammar_below(line.strip())
            self._number += 1
            self._check_idle()
        return text[start:]

    def _grammar_below(self, header: bytes) -> Grammar:
        """Grammar of the lines below a header."""
        if grammar := _grammar_of(header):
            self.usual = read_usual if grammar is layout else None
            return grammar
        commas = header.replace(b";", b",").replace(b"\t", b",")
        if _grammar_of(commas):
            raise LogError(f"{self.path}: a log of frames without commas between its columns; export it with commas")
        for kind, parse in GRAMMARS.items():
            if _is_frame(parse, commas):
                raise LogError(f"{self.path}: begins with a frame; put the header {kind!r} above it")
        if TABLE.fullmatch(header):
            raise LogError(decoded_table(self.path, header))
        error = f"expected the header {HEADER.decode()!r} of a python-can log, found {shown(header)}"
        raise LogError(f"{self.path}:{self._number}: {error}; give another log")

    def _layout(self, line: bytes) -> Layout | None:
        assert self._grammar is not None
        return self._grammar(line)

    def _settle(self, lines: Lines, ended: bool) -> None:
        self._hand_over(lines, sorted(lines.odd), ended, can.CSVReader)

    def _reader_head(self) -> bytes:
        return HEADER + b"\n"

    def _unread(self, line: str) -> None:
        if line.encode().strip() != HEADER:
            super()._unread(line)


def _is_frame(parse: Grammar, line: bytes) -> bool:
    try:
        return parse(line) not in (None, NOTHING)
    except BadLineError:
        return False


def _grammar_of(header: bytes) -> Grammar | None:
    """Grammar of the lines below the header of a known log."""
    if header == HEADER:
        return layout
    if gvret_line.HEADER.fullmatch(header):
        return gvret_line.layout
    frame = mdf2csv_line.pattern(header)
    return frame and partial(mdf2csv_line.layout, frame=frame)


def decoded_table(path: Path, header: bytes = b"") -> str:
    """Error message for a table of decoded values given as a log, with the options that read it."""
    columns = f" (its columns: {shown(header)})" if header else ""
    return f"{path}: a table of decoded values, not a log of frames{columns}; {GIVE_COLUMNS}"


def layout(line: bytes) -> Layout | None:
    """Parse a line of python-can; None if it is not a plain data frame."""
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


GRAMMARS: dict[str, Grammar] = {  # of lines, by their header
    HEADER.decode(): layout,
    "Time Stamp,ID,Extended,Dir,Bus,LEN,D1,D2,D3,D4,D5,D6,D7,D8": gvret_line.layout,
}

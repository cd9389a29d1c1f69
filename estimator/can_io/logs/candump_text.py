"""Many lines of candump output at once.

Lines of one layout differ in digits only. The grammar is asked about one line; all lines of the same length that equal
it outside its digits, and have digits where it has them, are then converted together by columns.
"""

from collections import Counter
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from estimator.can_io.frames import CLASSIC_BYTES, EXTENDED, FD_BYTES, Frames
from estimator.can_io.logs.candump_line import (
    BLANK,
    ERROR_FLAG,
    LARGEST_EXTENDED,
    LARGEST_STANDARD,
    BadLineError,
    Layout,
    layout,
)
from estimator.can_io.logs.log import ERROR_FRAME, REMOTE_FRAME

NEWLINE = 0x0A
NO_DIGIT = 0xFF
HEX = np.full(256, NO_DIGIT, np.uint8)  # value of a character as a hexadecimal digit
for _digits in (b"0123456789abcdef", b"0123456789ABCDEF"):
    HEX[list(_digits)] = range(16)
SKIP, DATA, ERROR, REMOTE = range(4)  # what a line is


class Parsed(NamedTuple):
    """The data frames of some lines, counts of the others, and the first bad line: its number from 0 and why."""

    frames: Frames
    skipped: Counter[str]
    bad: tuple[int, BadLineError] | None


def parse_lines(text: bytes) -> Parsed:
    """Convert whole lines, each ended by a newline, up to the first that does not parse."""
    window = np.frombuffer(text, np.uint8)
    ends = np.flatnonzero(window == NEWLINE)
    starts = np.concatenate(([0], ends[:-1] + 1))
    lines = _Lines(len(ends))
    lengths = ends - starts
    order = np.argsort(lengths, kind="stable")
    bad: tuple[int, BadLineError] | None = None
    for rows in np.split(order, np.flatnonzero(np.diff(lengths[order])) + 1):
        width = int(lengths[rows[0]]) if len(rows) else 0
        if width == 0:
            continue
        table = sliding_window_view(window, width)[starts[rows]]
        while len(rows):  # the first row is the earliest line left
            try:
                found = layout(table[0].tobytes())
            except BadLineError as error:
                bad = min(bad, (int(rows[0]), error), key=lambda one: one[0]) if bad else (int(rows[0]), error)
                break
            same = _same_layout(table, found)
            lines.put(rows[same], table[same], found)
            rows, table = rows[~same], table[~same]
    return Parsed(*lines.frames(bad[0] if bad else len(ends)), bad)


def _same_layout(table: NDArray[np.uint8], found: Layout) -> NDArray[np.bool_]:
    hexadecimal = [*range(*found.ident), *found.data, *(column + 1 for column in found.data)]
    decimal = [*range(*found.seconds), *range(*found.fraction)]
    literal = np.ones(table.shape[1], np.bool_)
    literal[hexadecimal + decimal] = False
    same: NDArray[np.bool_] = (table[:, literal] == table[0, literal]).all(axis=1)
    same &= (table[:, decimal] - np.uint8(ord("0")) <= 9).all(axis=1)
    same &= (HEX[table[:, hexadecimal]] != NO_DIGIT).all(axis=1)
    if found.ident[1] - found.ident[0] == 3:
        same &= _number(HEX[table[:, slice(*found.ident)]], 16) <= LARGEST_STANDARD
    elif found is not BLANK:
        same &= _number(HEX[table[:, slice(*found.ident)]], 16) <= LARGEST_EXTENDED
    return same


def _number(digits: NDArray[np.uint8], base: int) -> NDArray[np.int64]:
    value = np.zeros(len(digits), np.int64)
    for column in digits.T:
        value = value * base + column
    return value


class _Lines:
    """The values of lines, filled in by layout."""

    def __init__(self, count: int) -> None:
        self._t = np.zeros(count)
        self._ident = np.zeros(count, np.uint32)
        self._length = np.zeros(count, np.uint8)
        self._data = np.zeros((count, CLASSIC_BYTES), np.uint8)
        self._kind = np.full(count, SKIP, np.uint8)

    def put(self, rows: NDArray[np.int64], table: NDArray[np.uint8], found: Layout) -> None:
        if found is BLANK:
            return
        fraction = table[:, slice(*found.fraction)]
        seconds = _number(table[:, slice(*found.seconds)] - np.uint8(ord("0")), 10)
        scale = 10 ** fraction.shape[1]
        parts = _number(fraction - np.uint8(ord("0")), 10)
        whole = seconds * scale + parts  # exact as a float below 2**53; else two roundings are as good
        exact = (whole < 2**53) & (seconds < 2**63 // scale)
        self._t[rows] = np.where(exact, whole / scale, seconds + parts / scale)
        ident = _number(HEX[table[:, slice(*found.ident)]], 16)
        extended = found.ident[1] - found.ident[0] == 8
        self._ident[rows] = ident | (EXTENDED if extended else 0)
        self._kind[rows] = np.where(ident & ERROR_FLAG != 0, ERROR, REMOTE if found.remote else DATA)
        self._length[rows] = len(found.data)
        if len(found.data) > self._data.shape[1]:
            self._data = np.pad(self._data, ((0, 0), (0, FD_BYTES - CLASSIC_BYTES)))
        high = HEX[table[:, found.data.start : found.data.stop : found.data.step]]
        low = HEX[table[:, [column + 1 for column in found.data]]]
        self._data[rows, : len(found.data)] = high << 4 | low

    def frames(self, count: int) -> tuple[Frames, Counter[str]]:
        """Give what the first ``count`` lines hold."""
        kind = self._kind[:count]
        keep = np.flatnonzero(kind == DATA)
        skipped = Counter(
            {
                ERROR_FRAME: int(np.count_nonzero(kind == ERROR)),
                REMOTE_FRAME: int(np.count_nonzero(kind == REMOTE)),
            }
        )
        frames = Frames(self._t, self._ident, self._length, self._data)
        return (frames if len(keep) == len(self._t) else frames[keep]), +skipped

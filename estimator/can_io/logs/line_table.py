"""Vectorised reading of many lines of a text log.

Lines of one layout differ in digits only. The grammar parses one line. All lines of equal length that equal it outside
its values, and have digits in the same columns, are then converted together.
"""

import binascii
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from estimator.can_io.frames import CLASSIC_BYTES, EXTENDED, FD_BYTES, Frames, widened
from estimator.can_io.logs.channels import MAX_CHANNELS, UNNAMED, Numbers
from estimator.can_io.logs.digits import WORD, decimal, hexadecimal, nibbles, with_fraction
from estimator.can_io.logs.line_layout import ERROR_FLAG, NOTHING, BadLineError, Coding, Layout
from estimator.can_io.logs.log import ERROR_FRAME, REMOTE_FRAME
from estimator.signals import Floats, Mask

Grammar = Callable[[bytes], Layout | None]
Bytes = NDArray[np.uint8]
Rows = NDArray[np.intp]
Usual = Callable[[Bytes, Rows, Rows], tuple[Rows, Frames]]  # of a buffer, starts and ends of lines

BEFORE, BEHIND = 2 * WORD, 4 * WORD  # bytes around the lines, so that words can be read that only overlap them
NEWLINE = 0x0A
NO_DIGIT = 0xFF
DIGITS = 10
BASE64 = np.full(256, NO_DIGIT, np.uint8)  # value of a character
BASE64[list(b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/")] = range(64)
PAD = ord("=")
MAX_BAD = 100  # lines of one length that are not of the format, after which no more are looked for
MAX_LAYOUTS = 64  # among lines of one length; where there are more, the rest is taken line by line
EXACT_DIGITS, EXACT_BITS = 15, 53  # of a number that a float holds exactly
SKIP, DATA, ERROR, REMOTE = range(4)  # what a line is


class _Columns(NamedTuple):
    """Values (n,) and payloads (n, k) of the lines of one layout, which are the ``rows`` (n,) of the table."""

    rows: Rows
    t: Floats
    ident: NDArray[np.int64]
    data: Bytes


class Lines:
    """Values of lines, filled in layout by layout.

    Attributes
    ----------
    t : ndarray
        Times (n,) [s]; 0 for a line without one.
    odd : list[int]
        Lines that the grammar leaves open.
    bad : dict[int, BadLineError]
        Lines that are not of the format, unordered, with the reason: the first MAX_BAD of each length.
    channels : list[str]
        Names of the channels.
    """

    def __init__(self, text: bytes, grammar: Grammar, usual: Usual | None = None) -> None:
        self._window = np.frombuffer(b"".join([bytes(BEFORE), text, bytes(BEHIND)]), np.uint8)
        self._ends = np.flatnonzero(self._window == NEWLINE)
        self._starts = np.concatenate(([BEFORE], self._ends[:-1] + 1))
        count = len(self._ends)
        self.t = np.zeros(count)
        self.odd: list[int] = []
        self.bad: dict[int, BadLineError] = {}
        self._ident = np.zeros(count, np.uint32)
        self._length = np.zeros(count, np.uint8)
        self._data = np.zeros((count, CLASSIC_BYTES), np.uint8)
        self._kind = np.full(count, SKIP, np.uint8)
        self._channel = np.zeros(count, np.uint16)  # index in `channels`
        self.channels: list[str] = []
        rows = np.arange(count)
        if usual is not None:
            rows = self._put_usual(*usual(self._window, self._starts, self._ends))
        self._parse(rows, grammar)

    def __len__(self) -> int:
        return len(self._ends)

    def line(self, row: int) -> bytes:
        """Return a line without its line break."""
        return self._window[self._starts[row] : self._ends[row]].tobytes()

    def put(self, row: int, frames: Frames, kind: str = "", channel: str = "") -> None:
        """Add the frame of an odd line; ``kind`` is the kind of a frame without data."""
        self.t[row], self._ident[row], self._length[row] = frames.t[0], frames.ident[0], frames.length[0]
        self._put_data(np.array([row]), frames.data)
        self._kind[row] = {ERROR_FRAME: ERROR, REMOTE_FRAME: REMOTE}.get(kind, DATA)
        self._channel[row] = self._index_of(channel)

    def refuse(self, row: int, reason: str) -> None:
        """Note that a line is not of the format."""
        self.bad[row] = BadLineError(reason)

    def frames(self, end: int | None = None) -> tuple[Frames, Numbers, Counter[str]]:
        """Return the data frames (n,) before the line ``end``, indices (n,) of their channels, and counts of others."""
        kind = self._kind[:end]
        counts = np.bincount(kind, minlength=REMOTE + 1).tolist()
        skipped = Counter({ERROR_FRAME: counts[ERROR], REMOTE_FRAME: counts[REMOTE]})
        frames = Frames(self.t, self._ident, self._length, self._data)
        if counts[DATA] == len(self):
            return frames, self._channel, +skipped
        rows = np.flatnonzero(kind == DATA)
        return frames[rows], self._channel[rows], +skipped

    def _index_of(self, channel: str) -> int:
        if channel not in self.channels:
            if len(self.channels) == MAX_CHANNELS:
                raise BadLineError(f"more than {MAX_CHANNELS} channels")
            self.channels.append(channel)
        return self.channels.index(channel)

    def _put_usual(self, rows: Rows, frames: Frames) -> Rows:
        """Add data frames that were read without the grammar; returns the remaining rows."""
        if not len(rows):
            return np.arange(len(self))
        index: Rows | slice = slice(None) if len(rows) == len(self) else rows
        self.t[index], self._ident[index], self._length[index] = frames.t, frames.ident, frames.length
        self._data[index], self._kind[index], self._channel[index] = frames.data, DATA, self._index_of(UNNAMED)
        return np.flatnonzero(self._kind == SKIP)

    def _parse(self, rows: Rows, grammar: Grammar) -> None:
        """Parse some lines by the grammar."""
        lengths = (self._ends - self._starts)[rows]
        order = np.argsort(lengths, kind="stable")
        for same in np.split(order, np.flatnonzero(np.diff(lengths[order])) + 1):
            if len(same) and lengths[same[0]]:
                self._parse_group(rows[same], int(lengths[same[0]]), grammar)

    def _parse_group(self, rows: Rows, width: int, grammar: Grammar) -> None:
        """Parse lines of one length, the first row being the earliest."""
        table = sliding_window_view(self._window, -(-width // WORD) * WORD)[self._starts[rows]]
        layouts = 0
        while len(rows):
            if layouts == MAX_LAYOUTS:
                self._parse_singly(rows, grammar)
                return
            try:
                layout = grammar(table[0, :width].tobytes())
                if layout is not None and layout is not NOTHING:
                    self._index_of(layout.channel.decode("ascii", "replace"))
            except BadLineError as error:
                layout, self.bad[int(rows[0])] = None, error
            layouts += 1
            if int(rows[0]) in self.bad:
                same = np.zeros(1, np.intp)
            elif layout is None:
                self.odd.append(int(rows[0]))
                same = np.zeros(1, np.intp)
            elif layout is NOTHING:
                same = np.flatnonzero((table[:, :width] == table[0, :width]).all(axis=1))
            else:
                columns = _read_columns(table, layout)
                self._put_columns(rows[columns.rows], columns, layout)
                same = columns.rows
                if not len(same) or same[0]:  # the line that was parsed has values that are none
                    self.odd.append(int(rows[0]))
                    same = np.concatenate((np.zeros(1, np.intp), same))
            if len(same) == 1:
                rows, table = rows[1:], table[1:]
            else:
                left = np.ones(len(rows), np.bool_)
                left[same] = False
                rows, table = rows[left], table[left]

    def _parse_singly(self, rows: Rows, grammar: Grammar) -> None:
        """Parse lines one by one: for one line, columns of a table take 20 times as long."""
        most = len(self.bad) + MAX_BAD
        for row in rows.tolist():
            if len(self.bad) > most:
                return
            try:
                line = self.line(row)
                layout = grammar(line)
                if layout is not NOTHING and (layout is None or not self._put_line(row, line, layout)):
                    self.odd.append(row)
            except BadLineError as error:
                self.bad[row] = error

    def _put_line(self, row: int, line: bytes, layout: Layout) -> bool:
        """Add the frame of a line; returns False if one of its values is invalid."""
        channel = self._index_of(layout.channel.decode("ascii", "replace"))
        seconds, fraction, ident, number = (
            line[slice(*part)] for part in (layout.seconds, layout.fraction, layout.ident, layout.number)
        )
        try:
            bits, data = int(ident, 16), _payload(line, layout)
        except ValueError:
            return False
        if bits > layout.largest or not (seconds + fraction + number.lstrip(b" ")).isdigit():
            return False
        t = float(b"%s.%s" % (seconds, fraction)) / layout.per_second + layout.offset
        self.t[row], self._length[row] = t, layout.length
        self._ident[row] = bits | (EXTENDED if layout.extended else 0)
        self._put_data(np.array([row]), np.frombuffer(data, np.uint8)[None])
        self._channel[row], self._kind[row] = channel, REMOTE if layout.remote else DATA
        if bits & ERROR_FLAG:
            self._kind[row] = ERROR
        return True

    def _put_columns(self, rows: Rows, columns: _Columns, layout: Layout) -> None:
        self.t[rows] = columns.t
        self._ident[rows] = columns.ident | (EXTENDED if layout.extended else 0)
        self._length[rows] = layout.length
        self._put_data(rows, columns.data)
        if channel := self._index_of(layout.channel.decode("ascii", "replace")):  # zeros are there
            self._channel[rows] = channel
        self._kind[rows] = np.where(columns.ident & ERROR_FLAG != 0, ERROR, REMOTE if layout.remote else DATA)

    def _put_data(self, rows: Rows, data: Bytes) -> None:
        if data.shape[1] > self._data.shape[1]:
            self._data = widened(self._data, FD_BYTES)
        self._data[rows, : data.shape[1]] = data


def _read_columns(table: Bytes, layout: Layout) -> _Columns:
    """Read the lines of a table (n, whole words) that have the layout of its first line."""
    rows = np.flatnonzero(_equal_outside_values(table, layout))
    same = table if len(rows) == len(table) else table[rows]
    seconds, good = decimal(same[:, slice(*layout.seconds)])
    parts, valid = decimal(same[:, slice(*layout.fraction)])
    good &= valid
    ident, valid = hexadecimal(same[:, slice(*layout.ident)])
    good &= valid & (ident <= layout.largest) & _is_number(same[:, slice(*layout.number)])
    data, valid = _hex_payload(same, layout) if layout.coding is Coding.HEX else _base64_payload(same, layout)
    good &= valid
    if good.all():
        return _Columns(rows, _seconds(_times(same, layout, seconds, parts), layout), ident, data)
    t = _seconds(_times(same[good], layout, seconds[good], parts[good]), layout)
    return _Columns(rows[good], t, ident[good], data[good])


def _seconds(number: Floats, layout: Layout) -> Floats:
    """Times (n,) [s] from the numbers in lines."""
    if (layout.per_second, layout.offset) == (1.0, 0.0):
        return number
    t: Floats = number / layout.per_second + layout.offset
    return t


def _payload(line: bytes, layout: Layout) -> bytes:
    """Payload of a line; raises ValueError if it is invalid."""
    text = b"".join(line[column : column + layout.coding.value] for column in layout.data)
    if layout.coding is Coding.BASE64:
        return binascii.a2b_base64(text, strict_mode=True)[: layout.length]
    return binascii.unhexlify(text)[len(layout.data) - layout.length :]


def _equal_outside_values(table: Bytes, layout: Layout) -> Mask:
    literal = np.zeros(table.shape[1], np.uint8)
    literal[: layout.end + 1] = 0xFF  # and the column after, which ends the last value
    for part in (layout.seconds, layout.fraction, layout.ident, layout.number):
        literal[slice(*part)] = 0
    for column in layout.data:
        literal[column : column + layout.coding.value] = 0
    if layout.coding is Coding.BASE64:
        literal[: layout.end][table[0, : layout.end] == PAD] = 0xFF
    differing = np.zeros(len(table), np.uint64)
    for mask, column in zip(literal.view(np.uint64), table.view(np.uint64).T, strict=True):
        if mask:
            differing |= (column ^ column[0]) & mask
    equal: Mask = differing == 0
    return equal


def _is_number(chars: Bytes) -> Mask:
    """Mask (n,) of rows of characters (n, k) that are spaces followed by digits up to the last."""
    good, is_digit = np.ones(len(chars), np.bool_), np.zeros(len(chars), np.bool_)
    for column in chars.T:
        was_digit, is_digit = is_digit, column - ord("0") < DIGITS  # unsigned: a character below "0" gives a large one
        good &= is_digit | ((column == ord(" ")) & ~was_digit)
    return good & is_digit if chars.shape[1] else good


def _shifted(columns: range, by: int) -> slice:
    return slice(columns.start + by, columns.stop + by if len(columns) else columns.start + by, columns.step)


def _times(table: Bytes, layout: Layout, seconds: NDArray[np.int64], parts: NDArray[np.int64]) -> Floats:
    """Numbers (n,) from the digits before and after the point, bit-identical to those of `float`."""
    digits = layout.fraction[1] - layout.fraction[0]
    if digits > EXACT_DIGITS:
        return _parsed(table, layout)
    scale = 10**digits
    if seconds.max(initial=0) < 2**EXACT_BITS // scale:
        t: Floats = (seconds * scale + parts) / scale  # both exact, and rounded once
        return t
    t, doubtful = with_fraction(seconds, parts, scale)
    if len(doubtful):
        t[doubtful] = _parsed(table[doubtful], layout)
    return t


def _parsed(table: Bytes, layout: Layout) -> Floats:
    text = np.ascontiguousarray(table[:, layout.seconds[0] : layout.fraction[1]])
    return np.array([float(row.tobytes()) for row in text])


def _hex_payload(table: Bytes, layout: Layout) -> tuple[Bytes, Mask]:
    if not layout.length:
        return np.zeros((len(table), 0), np.uint8), np.ones(len(table), np.bool_)
    high, valid = nibbles(table[:, _shifted(layout.data, 0)])
    low, good = nibbles(table[:, _shifted(layout.data, 1)])
    data = (high << np.uint64(4) | low).view(np.uint8)
    return data[:, data.shape[1] - layout.length :], valid & good


def _base64_payload(table: Bytes, layout: Layout) -> tuple[Bytes, Mask]:
    digits: list[Bytes] = [BASE64[table[:, _shifted(layout.data, i)]] for i in range(4)]
    data = np.zeros((len(table), 3 * len(layout.data)), np.uint8)
    for i in range(3):
        data[:, i::3] = digits[i] << 2 * (i + 1) | digits[i + 1] >> 4 - 2 * i
    pads = [table[:, _shifted(layout.data, i)] == PAD for i in range(4)]
    valid = [((digit < NO_DIGIT) | pad).all(axis=1) for digit, pad in zip(digits, pads, strict=True)]
    every: Mask = np.all(valid, axis=0)
    return data[:, : layout.length], every

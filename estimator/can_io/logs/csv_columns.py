"""Vectorised reading of the usual lines of a python-can .csv log, for any widths of their fields.

``1700000000.0313795,0xcf00400,1,0,0,8,P/+BwBL///8=``: python-can writes times with a varying number of digits, so few
lines have one layout. Here each field is a 64-bit word of eight characters, read from the end of the previous field.
Every character of a line is checked; an unusual line is left to the grammar.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.can_io.frames import EXTENDED, FIRST_BYTES, Frames
from estimator.can_io.logs.digits import (
    WORD,
    ZERO,
    Words,
    decimal_digits,
    decimal_words,
    hexadecimal_digits,
    hexadecimal_words,
    last_digits,
    with_fraction,
    with_zeros,
)
from estimator.can_io.logs.line_layout import MAX_EXTENDED_ID, MAX_STANDARD_ID
from estimator.signals import Floats, Mask

Bytes = NDArray[np.uint8]
Places = NDArray[np.intp]

MAX_SECONDS, MAX_FRACTION = 12, WORD  # digits
POWERS = 10 ** np.arange(MAX_FRACTION + 1)
SPACE = 4 * WORD  # bytes behind a point that a line's words may take before it is known whether they are the line's
CHARACTERS = (0, 2, 3, 4, 6, 7, 8, 10, 11)  # base64 digits of a payload, by its length [bytes]
PADDED = np.array([0, 4, 4, 4, 8, 8, 8, 12, 12])  # the same with the signs that fill groups of four
NO_PAIR = 0xF000  # bits that no value of two base64 digits has


def _word(text: bytes) -> np.uint64:
    return np.uint64(int.from_bytes(text, "little"))


FLAG_TEXT, FLAG_PLACES = _word(b",0,0,0,0"), _word(b"\xff\xfe\xff\xff\xff\xff\xff\x00")  # 0 or 1; any length
PAIR, NO_PAIRS = np.uint64(0xFFF), _word(NO_PAIR.to_bytes(2, "little") * 4)


def _payload_masks() -> tuple[Words, Words, Words, Words]:
    """Masks and texts (2, 9) for both words of a base64 payload, by its length.

    They are the mask of its digits, the digits "A" for the other places, the signs "=", and the mask of their places.
    """
    masks = np.zeros((4, len(CHARACTERS), 2 * WORD), np.uint8)
    kept, filling, signs, places = masks
    for length, (used, padded) in enumerate(zip(CHARACTERS, PADDED.tolist(), strict=True)):
        kept[length, :used] = 0xFF
        filling[length, used:] = ord("A")  # the digit 0
        signs[length, used:padded] = ord("=")
        places[length, used:] = 0xFF
        places[length, padded:] = 0
    first, second, third, fourth = np.ascontiguousarray(masks.view("<u8").swapaxes(1, 2))
    return first, second, third, fourth


def _pairs() -> NDArray[np.uint16]:
    """Table of the values of two base64 digits, by the two characters as a little-endian number."""
    digit = np.full(256, NO_PAIR, np.uint16)
    digit[list(b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/")] = range(64)
    second, first = digit[:, None], digit[None, :]
    return np.where((first | second) & NO_PAIR, np.uint16(NO_PAIR), first << 6 | second).astype(np.uint16).ravel()


KEPT, FILLING, SIGNS, SIGN_PLACES = _payload_masks()
PAIRS = _pairs()


def read_usual(buffer: Bytes, starts: Places, ends: Places) -> tuple[Places, Frames]:
    """Row numbers of usual lines, which are data frames of a classic bus, and their frames.

    Parameters
    ----------
    buffer : ndarray
        Lines, with at least two words before and four words after them.
    starts, ends : ndarray
        Positions (n,) at which lines begin and end.
    """
    words: Words = np.ndarray((len(buffer) - WORD + 1,), "<u8", buffer.data, 0, (1,))  # those from each byte on
    ends = ends - (buffer[ends - 1] == ord("\r"))
    point = _points(buffer, starts)
    rows = np.flatnonzero((point > starts) & (point <= starts + MAX_SECONDS) & (point < len(buffer) - SPACE))
    if len(rows) < len(starts):
        starts, ends, point = starts[rows], ends[rows], point[rows]
    t, comma, good = _times(buffer, words, starts, point)
    ident, behind, valid = _idents(buffer, words, comma)
    good &= valid & (behind < ends)
    length, payload, valid = _payloads(buffer, words, np.minimum(behind, len(buffer) - SPACE), ends)
    good &= valid
    frames = Frames(t, ident, length.astype(np.uint8), payload.view(np.uint8).reshape(-1, WORD))
    return (rows, frames) if good.all() else (rows[good], frames[good])


def _points(buffer: Bytes, starts: Places) -> Places:
    """Positions (n,) of the first point from each start on; the length of the buffer if there is none."""
    points = np.flatnonzero(buffer == ord("."))
    if len(points) == len(starts):  # one a line, or lines are unusual
        return points
    return np.append(points, len(buffer))[np.searchsorted(points, starts)]


def _times(buffer: Bytes, words: Words, start: Places, point: Places) -> tuple[Floats, Places, Mask]:
    """Times (n,) [s] as `float` reads them, positions after them (n,), and mask of the usual ones (n,)."""
    whole_digits = point - start
    digits = last_digits(words[point - WORD], np.minimum(whole_digits, WORD))
    if whole_digits.max(initial=0) > WORD:
        digits = np.hstack([last_digits(words[point - 2 * WORD], np.maximum(whole_digits - WORD, 0)), digits])
    seconds, good = decimal_words(digits)
    fraction = words[point + 1]
    after = decimal_digits(fraction)
    parts, _ = decimal_words(with_zeros(fraction, after))
    t, doubtful = with_fraction(seconds, parts, POWERS[after])
    comma = point + 1 + after
    good &= after > 0
    for row in doubtful[good[doubtful]].tolist():
        t[row] = float(buffer[start[row] : comma[row]].tobytes())
    return t, comma, good


def _idents(buffer: Bytes, words: Words, comma: Places) -> tuple[NDArray[np.uint32], Places, Mask]:
    """Ids (n,) with their flag, positions after them (n,), and mask of usual ids and flags (n,)."""
    text = words[comma + 3]
    count = hexadecimal_digits(text)
    ident, _ = hexadecimal_words(with_zeros(text, count))
    behind = comma + 3 + count
    flags = words[behind]
    extended = (flags >> np.uint64(8) & np.uint64(1)).astype(np.bool_)
    good = (buffer[comma] == ord(",")) & (buffer[comma + 1] == ZERO) & (buffer[comma + 2] == ord("x")) & (count > 0)
    good &= (ident <= np.where(extended, MAX_EXTENDED_ID, MAX_STANDARD_ID)) & ((flags ^ FLAG_TEXT) & FLAG_PLACES == 0)
    return (ident | np.where(extended, EXTENDED, 0)).astype(np.uint32), behind, good


def _payloads(buffer: Bytes, words: Words, behind: Places, ends: Places) -> tuple[Places, Words, Mask]:
    """Lengths (n,) [bytes], payloads as zero-padded words (n,), and mask of the usual ones (n,)."""
    comma = behind + WORD
    length = buffer[comma - 1].astype(np.intp) - ZERO
    good = (length >= 0) & (length < len(PADDED)) & (buffer[comma] == ord(","))
    length[~good] = 0
    good &= ends - comma - 1 == PADDED[length]
    halves = []
    for half, text in enumerate((words[comma + 1], words[comma + 1 + WORD])):
        good &= (text ^ SIGNS[half][length]) & SIGN_PLACES[half][length] == 0
        digits = text & KEPT[half][length] | FILLING[half][length]
        pairs: Words = np.take(PAIRS, digits.view("<u2")).view("<u8")
        good &= pairs & NO_PAIRS == 0
        halves.append(pairs)
    first, second = halves
    value = (first & PAIR) << np.uint64(52) | (first >> np.uint64(16) & PAIR) << np.uint64(40)
    value |= (first >> np.uint64(32) & PAIR) << np.uint64(28) | first >> np.uint64(48) << np.uint64(16)
    value |= (second & PAIR) << np.uint64(4) | second >> np.uint64(24) & np.uint64(0xF)
    return length, value.byteswap() & FIRST_BYTES[length], good

"""Conversion of digits to numbers, eight characters at a time: each character is a byte of a 64-bit word.

A byte ``b`` below 0x80 is at least ``k`` if the top bit of ``b + 0x80 - k`` is set; such sums have no carry into other
bytes. Words are little-endian: the first character is the lowest byte.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.signals import Floats, Mask

Chars = NDArray[np.uint8]
Words = NDArray[np.uint64]
Counts = NDArray[np.uint8]

WORD = 8  # characters
ZERO = ord("0")
MAX_ROUNDING_ERROR = 2.0**-53  # of a fraction that is rounded once, and more


def _every(byte: int) -> np.uint64:
    return np.uint64(int.from_bytes(bytes([byte]) * WORD, "little"))


TOP, LOW_NIBBLE, ONES, CASE = _every(0x80), _every(0x0F), _every(1), _every(0x20)
SHIFTS = np.array([8 * (WORD - count) % 64 for count in range(WORD + 1)], np.uint64)  # bits, by a count of characters
ZEROS = np.array([int.from_bytes(b"0" * (WORD - count), "little") for count in range(WORD + 1)], np.uint64)
LAST = np.array([(1 << 64) - (1 << 8 * (WORD - count)) for count in range(WORD + 1)], np.uint64)  # masks, by a count
EVEN_BYTES, EVEN_PAIRS = np.uint64(0x00FF00FF00FF00FF), np.uint64(0x0000FFFF0000FFFF)


def _at_least(words: Words, character: str) -> Words:
    return words + _every(0x80 - ord(character))


def padded(chars: Chars) -> Words:
    """Convert characters (n, k) to words (n, m), padded with the digit 0 in front."""
    n, k = chars.shape
    wide = np.full((n, max(-(-k // WORD), 1) * WORD), ZERO, np.uint8)
    if k:
        wide[:, -k:] = chars
    return wide.view("<u8")


def _all_set(flags: Words) -> Mask:
    """Mask (n,) of rows of words (n, m) in which the top bit of every byte is set."""
    common = flags[:, 0]
    for column in flags.T[1:]:
        common = common & column
    good: Mask = common & TOP == TOP
    return good


def _are_decimal(words: Words) -> Words:
    """Words whose top bits flag the bytes that are decimal digits; the other bits have no meaning."""
    return _at_least(words, "0") & ~_at_least(words, ":") & ~words


def _are_hexadecimal(words: Words) -> Words:
    """Words whose top bits flag the bytes that are hexadecimal digits; the other bits have no meaning."""
    lower = words | CASE
    is_digit = _at_least(words, "0") & ~_at_least(words, ":")
    return (is_digit | _at_least(lower, "a") & ~_at_least(lower, "g")) & ~words


def decimal_digits(words: Words) -> Counts:
    """Number (n,) of leading characters of words (n,) that are decimal digits."""
    return _count(_are_decimal(words))


def hexadecimal_digits(words: Words) -> Counts:
    """Number (n,) of leading characters of words (n,) that are hexadecimal digits."""
    return _count(_are_hexadecimal(words))


def _count(flags: Words) -> Counts:
    others = ~flags & TOP
    first = others & (~others + np.uint64(1))  # the lowest bit that is set
    return np.bitwise_count(first - np.uint64(1)) // np.uint8(8)


def with_zeros(words: Words, count: "NDArray[np.integer[Any]]") -> Words:
    """Words (n, 1) of the first ``count`` characters of words (n,), one to eight, padded with 0 in front."""
    digits: Words = words << SHIFTS[count] | ZEROS[count]
    return digits[:, None]


def last_digits(words: Words, count: "NDArray[np.integer[Any]]") -> Words:
    """Words (n, 1) of the last ``count`` characters of words (n,), padded with 0 in front."""
    digits: Words = words & LAST[count] | ZEROS[count]
    return digits[:, None]


def decimal(chars: Chars) -> tuple[NDArray[np.int64], Mask]:
    """Numbers (n,) of up to 18 decimal digits (n, k), and True (n,) where all characters are digits."""
    return decimal_words(padded(chars))


def decimal_words(words: Words) -> tuple[NDArray[np.int64], Mask]:
    """Numbers (n,) as by `decimal`, of digits in words (n, m) padded with 0 in front."""
    valid = _all_set(_are_decimal(words))
    pairs = (words & LOW_NIBBLE) * np.uint64(10 * 256 + 1) >> np.uint64(8) & EVEN_BYTES
    fours = pairs * np.uint64(100 * 65536 + 1) >> np.uint64(16) & EVEN_PAIRS
    eights = fours * np.uint64(10_000 * 2**32 + 1) >> np.uint64(32)
    value = eights[:, 0]
    for column in eights.T[1:]:
        value = value * np.uint64(10**8) + column
    return value.astype(np.int64), valid


def nibbles(chars: Chars) -> tuple[Words, Mask]:
    """Values of hexadecimal digits (n, k), one byte each, as words (n, m), and True (n,) where all are digits."""
    return nibbles_of_words(padded(chars))


def nibbles_of_words(words: Words) -> tuple[Words, Mask]:
    """Values of digits as by `nibbles`, of digits in words (n, m) padded with 0 in front."""
    letter = words >> np.uint64(6) & ONES
    return (words & LOW_NIBBLE) + letter * np.uint64(9), _all_set(_are_hexadecimal(words))


def hexadecimal(chars: Chars) -> tuple[NDArray[np.int64], Mask]:
    """Numbers (n,) of up to 8 hexadecimal digits (n, k), and True (n,) where all characters are digits."""
    return hexadecimal_words(padded(chars))


def hexadecimal_words(words: Words) -> tuple[NDArray[np.int64], Mask]:
    """Numbers (n,) as by `hexadecimal`, of digits in words (n, 1) padded with 0 in front."""
    digits, valid = nibbles_of_words(words)
    swapped = digits[:, 0].byteswap()  # the last digit lowest
    pairs = (swapped | swapped >> np.uint64(4)) & EVEN_BYTES
    fours = (pairs | pairs >> np.uint64(8)) & EVEN_PAIRS
    return (fours | fours >> np.uint64(16)).astype(np.int64) & 0xFFFFFFFF, valid


def with_fraction(
    whole: NDArray[np.int64], parts: NDArray[np.int64], scale: "NDArray[np.int64] | int"
) -> tuple[Floats, NDArray[np.intp]]:
    """Numbers ``whole + parts / scale`` (n,), and indices of those that may differ from `float` in the last bit."""
    fraction = parts / scale
    value = whole + fraction
    # A second rounding, which is wrong only where the first one decided it.
    lost, unit = np.abs(fraction - (value - whole)), np.spacing(value)
    close = (np.abs(lost - unit / 2) <= MAX_ROUNDING_ERROR) | (np.abs(lost - unit / 4) <= MAX_ROUNDING_ERROR)
    return value, np.flatnonzero(close)

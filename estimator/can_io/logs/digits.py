"""Digits to numbers, eight characters at a time: each character is a byte of a 64-bit word.

A byte ``b`` below 0x80 is at least ``k`` where the top bit of ``b + 0x80 - k`` is set; such sums carry into no other
byte. Words are little-endian: the first character is the lowest byte.
"""

import numpy as np
from numpy.typing import NDArray

from estimator.signals import Mask

Chars = NDArray[np.uint8]
Words = NDArray[np.uint64]

WORD = 8  # characters
ZERO = ord("0")


def _every(byte: int) -> np.uint64:
    return np.uint64(int.from_bytes(bytes([byte]) * WORD, "little"))


TOP, LOW_NIBBLE, ONES, CASE = _every(0x80), _every(0x0F), _every(1), _every(0x20)
EVEN_BYTES, EVEN_PAIRS = np.uint64(0x00FF00FF00FF00FF), np.uint64(0x0000FFFF0000FFFF)


def _at_least(words: Words, character: str) -> Words:
    return words + _every(0x80 - ord(character))


def padded(chars: Chars) -> Words:
    """Characters (n, k) as words (n, m), with zeros in front."""
    n, k = chars.shape
    wide = np.full((n, max(-(-k // WORD), 1) * WORD), ZERO, np.uint8)
    if k:
        wide[:, -k:] = chars
    return wide.view("<u8")


def _all_set(flags: Words) -> Mask:
    """Where the top bit of every byte is set, in all words of a row (n, m)."""
    common = flags[:, 0]
    for column in flags.T[1:]:
        common = common & column
    good: Mask = common & TOP == TOP
    return good


def decimal(chars: Chars) -> tuple[NDArray[np.int64], Mask]:
    """Numbers (n,) of up to 18 decimal digits (n, k), and whether all are digits."""
    words = padded(chars)
    valid = _all_set(_at_least(words, "0") & ~_at_least(words, ":") & ~words)
    pairs = (words & LOW_NIBBLE) * np.uint64(10 * 256 + 1) >> np.uint64(8) & EVEN_BYTES
    fours = pairs * np.uint64(100 * 65536 + 1) >> np.uint64(16) & EVEN_PAIRS
    eights = fours * np.uint64(10_000 * 2**32 + 1) >> np.uint64(32)
    value = eights[:, 0]
    for column in eights.T[1:]:
        value = value * np.uint64(10**8) + column
    return value.astype(np.int64), valid


def nibbles(chars: Chars) -> tuple[Words, Mask]:
    """Values of hexadecimal digits (n, k), a byte each, as words (n, m) with zeros in front; and whether all are."""
    words = padded(chars)
    lower = words | CASE
    is_digit = _at_least(words, "0") & ~_at_least(words, ":")
    is_letter = _at_least(lower, "a") & ~_at_least(lower, "g")
    letter = words >> np.uint64(6) & ONES
    return (words & LOW_NIBBLE) + letter * np.uint64(9), _all_set((is_digit | is_letter) & ~words)


def hexadecimal(chars: Chars) -> tuple[NDArray[np.int64], Mask]:
    """Numbers (n,) of up to 8 hexadecimal digits (n, k), and whether all are digits."""
    digits, valid = nibbles(chars)
    swapped = digits[:, 0].byteswap()  # the last digit lowest
    pairs = (swapped | swapped >> np.uint64(4)) & EVEN_BYTES
    fours = (pairs | pairs >> np.uint64(8)) & EVEN_PAIRS
    return (fours | fours >> np.uint64(16)).astype(np.int64) & 0xFFFFFFFF, valid

"""Spoilt copies of bytes: what a disk, a cable or an attacker makes of them."""

from collections.abc import Callable, Sequence

import numpy as np

EXTREMES = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1)
WORDS = (b"nan", b"-inf", b"1e308", b"1e-308", b"1e17", b"-1", b"9" * 30, b"0" * 30, b"", b"\0", b'"', b"\xff", b"\r")
MORE, MAX_CHANGES = 0.6, 6  # probability that a change is the last, and the most of them
MAX_BYTES = 1 << 16  # of a spoilt copy
MAX_TIMES = 40  # that a part is repeated

Change = Callable[[bytes, Sequence[bytes], np.random.Generator], bytes]


def spoilt(data: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """A copy with random changes, mostly one or two, some of them parts of ``others``."""
    for _ in range(min(int(rng.geometric(MORE)), MAX_CHANGES)):
        data = _CHANGES[int(rng.integers(len(_CHANGES)))](data, others, rng)
    return data[:MAX_BYTES]


def _flipped(data: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    copy = bytearray(data)
    for place in rng.integers(0, max(len(data), 1), 3).tolist()[: len(data)]:
        copy[place] ^= 1 << int(rng.integers(8))
    return bytes(copy)


def _overwritten(data: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """An integer of 1 to 8 bytes, at its extreme, in either order of bytes."""
    width = int(2 ** rng.integers(0, 4))
    value = EXTREMES[int(rng.integers(len(EXTREMES)))] & (1 << 8 * width) - 1
    place = int(rng.integers(0, len(data) + 1))
    return data[:place] + value.to_bytes(width, "little" if rng.integers(2) else "big") + data[place + width :]


def _worded(data: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """A run of digits, or one character, is another word."""
    place = int(rng.integers(0, len(data) + 1))
    end = place + 1
    while end < len(data) and data[end : end + 1].isdigit():
        end += 1
    return data[:place] + WORDS[int(rng.integers(len(WORDS)))] + data[end:]


def _without(data: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    first, last = _part(data, rng)
    return data[:first] + data[last:]


def _cut(data: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    return data[: int(rng.integers(0, len(data) + 1))]


def _repeated(data: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    first, last = _part(data, rng)
    return data[:last] + data[first:last] * int(rng.integers(1, MAX_TIMES)) + data[last:]


def _spliced(data: bytes, others: Sequence[bytes], rng: np.random.Generator) -> bytes:
    """A part of another file between, or in the place of, a part of this one."""
    other = others[int(rng.integers(len(others)))]
    first, last = _part(other, rng)
    start, end = _part(data, rng)
    return data[:start] + other[first:last] + data[end if rng.integers(2) else start :]


def _part(data: bytes, rng: np.random.Generator) -> tuple[int, int]:
    first, last = sorted(rng.integers(0, len(data) + 1, 2).tolist())
    return first, last if rng.integers(2) else min(last, first + 16)


_CHANGES: tuple[Change, ...] = (_flipped, _overwritten, _worded, _without, _cut, _repeated, _spliced)

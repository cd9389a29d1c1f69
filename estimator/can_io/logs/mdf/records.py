"""Vectorised access to numbers and bytes of many records, for any arrangement in memory.

Records of one size are consecutive, or a table stored column by column, or scattered at known places. Only the
requested values are gathered.
"""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from estimator.can_io.logs.mdf.groups import REAL, UNSIGNED, Field, Times
from estimator.signals import Floats

Numbers = NDArray[np.unsignedinteger[Any]]
Bytes = NDArray[np.uint8]
SIZES = (1, 2, 4, 8)  # bytes of a number that are read at once


class Records(ABC):
    """Interface of records (n,); fields must lie inside them."""

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def first(self, count: int) -> "Records":
        """First ``count`` records."""

    @abstractmethod
    def numbers(self, byte: int, form: str) -> NDArray[Any]:
        """Values (n,) of a NumPy format, from a byte on."""

    @abstractmethod
    def bytes_at(self, byte: int, count: int) -> Bytes:
        """Bytes (n, count), from a byte on."""


class Rows(Records):
    """First ``count`` of the consecutive records of ``size`` bytes in ``data``."""

    def __init__(self, data: bytes | bytearray | memoryview, size: int, count: int) -> None:
        self._data = data
        self._size = size
        self._count = count

    def __len__(self) -> int:
        return self._count

    def first(self, count: int) -> "Rows":
        """First ``count`` records."""
        return Rows(self._data, self._size, count)

    def numbers(self, byte: int, form: str) -> NDArray[Any]:
        """Values (n,), as a view."""
        return np.ndarray((self._count,), form, self._data, byte, (self._size,))

    def bytes_at(self, byte: int, count: int) -> Bytes:
        """Bytes (n, count), as a view."""
        return np.ndarray((self._count, count), np.uint8, self._data, byte, (self._size, 1))


class Table(Records):
    """First ``count`` records of a table stored column by column, with ``rows`` bytes in a column."""

    def __init__(self, data: bytes | bytearray, rows: int, first: int, count: int) -> None:
        self._data = data
        self._rows = rows
        self._first = first
        self._count = count

    def __len__(self) -> int:
        return self._count

    def first(self, count: int) -> "Table":
        """First ``count`` records."""
        return Table(self._data, self._rows, self._first, count)

    def numbers(self, byte: int, form: str) -> NDArray[Any]:
        """Values (n,), assembled from columns."""
        return np.ascontiguousarray(self.bytes_at(byte, np.dtype(form).itemsize)).view(form)[:, 0]

    def bytes_at(self, byte: int, count: int) -> Bytes:
        """Bytes (n, count), as a view."""
        return np.ndarray((self._count, count), np.uint8, self._data, byte * self._rows + self._first, (1, self._rows))


class Scattered(Records):
    """Records that begin at the places ``at`` (n,) of a buffer, with room for the largest field after the last."""

    def __init__(self, data: bytes | bytearray, at: NDArray[np.int64]) -> None:
        self._data = data
        self._at = at

    def __len__(self) -> int:
        return len(self._at)

    def first(self, count: int) -> "Scattered":
        """First ``count`` records."""
        return Scattered(self._data, self._at[:count])

    def numbers(self, byte: int, form: str) -> NDArray[Any]:
        """Values (n,), gathered."""
        kind = np.dtype(form)
        window = np.ndarray((len(self._data) - kind.itemsize + 1,), kind, self._data, 0, (1,))
        return window[self._at + byte]

    def bytes_at(self, byte: int, count: int) -> Bytes:
        """Bytes (n, count), gathered."""
        return sliding_window_view(np.frombuffer(self._data, np.uint8), count)[self._at + byte]


def unsigned(records: Records, field: Field) -> Numbers:
    """Unsigned numbers (n,) of up to 64 bits, at any bit position."""
    if field.constant is not None:
        return np.full(len(records), field.constant, np.uint64)
    size, is_big = -(-(field.bit + field.bits) // 8), field.kind == UNSIGNED[1]
    if size in SIZES:
        value: Numbers = records.numbers(field.byte, f"{'>' if is_big else '<'}u{size}")
    else:
        value = np.zeros(len(records), np.uint64)
        for i in range(size):
            byte = field.byte + (size - 1 - i if is_big else i)
            value |= records.numbers(byte, "u1").astype(np.uint64) << np.uint64(8 * i)
    if field.bit:
        value = value >> value.dtype.type(field.bit)
    if field.bit + field.bits == 8 * value.dtype.itemsize:
        return value
    return value & value.dtype.type((1 << field.bits) - 1)


def times(records: Records, layout: Times, start: float) -> Floats:
    """Times (n,) [s], bit-identical to those of asammdf and python-can."""
    field = layout.field
    if field.kind in REAL:
        raw = records.numbers(field.byte, f"{'>' if field.kind == REAL[1] else '<'}f{field.bits // 8}")
    else:
        raw = unsigned(records, field)
    with np.errstate(over="ignore", invalid="ignore"):  # what is then no time is refused
        if (layout.factor, layout.offset) != (1, 0):
            raw = raw * layout.factor
            if layout.offset:
                raw = raw + layout.offset
        return raw.astype(np.float64) + start

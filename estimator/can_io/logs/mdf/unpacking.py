"""Unpacking of the data of packed blocks, by the methods of ASAM MDF 4.3.

Zlib is always there. Zstandard and LZ4 need a package each.
"""

import sys
from typing import Protocol

from estimator.can_io.logs.inflate import inflate

DEFLATED, ZSTANDARD, LZ4 = 0, 2, 4  # methods; the next higher number of each has the bytes of a record transposed
TRANSPOSED = 1
METHODS = range(6)
MAX_WINDOW_BITS = 26  # of the memory that packed data may ask for: 64 MiB


class MissingPackageError(ImportError):
    """The package that unpacks a method is not installed."""


class Unpacker(Protocol):
    """What unpacks a stream of bytes piece by piece."""

    @property
    def eof(self) -> bool:
        """Whether all was unpacked."""

    def decompress(self, data: bytes, /, max_length: int = -1) -> bytes:
        """At most ``max_length`` bytes of the contents."""


def unpack(method: int, packed: bytes, size: int, most: int) -> tuple[bytes | bytearray, str]:
    """Unpack data that hold ``size`` bytes as their writer said, at most ``most``.

    Returns
    -------
    tuple[bytes | bytearray, str]
        The contents as far as they are there, and what is wrong with the packed data, if anything.

    Raises
    ------
    MissingPackageError
        There is no package for the method.
    """
    if method == DEFLATED:
        return inflate(packed, size, most)
    unpacker, damage = _zstandard() if method == ZSTANDARD else _lz4()
    try:
        return unpacker.decompress(packed, max_length=min(size, most) + 1), "" if unpacker.eof else "do not end"
    except (damage, EOFError):
        return b"", "are damaged"


def _zstandard() -> tuple[Unpacker, type[Exception]]:
    try:
        if sys.version_info >= (3, 14):
            from compression import zstd
        else:
            from backports import zstd
    except ImportError as error:
        raise MissingPackageError("Zstandard") from error
    options: dict[int, int] = {zstd.DecompressionParameter.window_log_max: MAX_WINDOW_BITS}
    return zstd.ZstdDecompressor(options=options), zstd.ZstdError


def _lz4() -> tuple[Unpacker, type[Exception]]:
    try:
        from lz4 import frame
    except ImportError as error:
        raise MissingPackageError("LZ4") from error
    return frame.LZ4FrameDecompressor(), RuntimeError

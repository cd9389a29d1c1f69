"""Unpacking of the data of packed blocks, by the methods of ASAM MDF 4.3.

Zlib is always available. Zstandard and LZ4 need a package each.
"""

import sys
from typing import Protocol

from estimator.can_io.logs.inflate import inflate

DEFLATED, ZSTANDARD, LZ4 = 0, 2, 4  # methods; the next higher number of each has the bytes of a record transposed
TRANSPOSED = 1
METHODS = range(6)
MAX_WINDOW_BITS = 26  # of the memory that packed data may ask for: 64 MiB


class MissingPackageError(ImportError):
    """Raised if the package for a method of packing is not installed."""


class Unpacker(Protocol):
    """Interface of an object that unpacks a stream of bytes in pieces."""

    @property
    def eof(self) -> bool:
        """True if the stream is unpacked completely."""

    def decompress(self, data: bytes, /, max_length: int = -1) -> bytes:
        """Unpack at most ``max_length`` bytes of the contents."""


def unpack(method: int, packed: bytes, size: int, most: int) -> tuple[bytes | bytearray, str]:
    """Unpack data whose writer states ``size`` bytes of contents; at most ``most`` bytes are unpacked.

    Returns
    -------
    tuple[bytes | bytearray, str]
        Available contents, and the error of the packed data; empty without one.

    Raises
    ------
    MissingPackageError
        The package for the method is not installed.
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

"""Unpacking of zlib data of known size, by libdeflate if installed: two to three times as fast as zlib."""

import zlib
from importlib.util import find_spec

if find_spec("deflate") is not None:
    from deflate import DeflateError, zlib_decompress
else:  # machines for which there is no wheel

    class DeflateError(Exception):  # type: ignore[no-redef]
        """Raised where data cannot be unpacked in one go."""

    def zlib_decompress(data: bytes, originalsize: int) -> bytes:  # type: ignore[misc]
        """Leave it to zlib."""
        raise DeflateError


def inflate(packed: bytes, size: int, most: int) -> tuple[bytes | bytearray, str]:
    """Unpack data whose writer states ``size`` bytes of contents; at most ``most`` bytes are unpacked.

    Returns
    -------
    tuple[bytes | bytearray, str]
        Available contents, and the error of the packed data; empty without one.
    """
    if 0 < size <= most:
        try:
            data = zlib_decompress(packed, size)
        except DeflateError:  # zlib gives what can be had, or finds another size
            pass
        else:
            if len(data) == size:
                return data, ""
    unpacking = zlib.decompressobj()
    try:
        return unpacking.decompress(packed, most), "" if unpacking.eof else "do not end"
    except zlib.error:
        return b"", "are damaged"

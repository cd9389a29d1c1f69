"""Bytes of a log file, unpacked if it is gzipped, and the share of it that has been read."""

import errno
import gzip
import io
import os
from pathlib import Path
from types import TracebackType
from typing import Any

PIECE = 1 << 20  # bytes asked for at once, so that a bogus length reserves no memory
MAX_RATIO = 200  # unpacked over packed bytes (usual: 5 to 40), where over UNSUSPECTED are unpacked
UNSUSPECTED = 16 << 20  # bytes


class Unpacked(io.RawIOBase):
    """Contents of a gzip file; reading raises OSError if they exceed MAX_RATIO times its size.

    Such a file is no log, and would exhaust memory or time.
    """

    def __init__(self, packed: io.BufferedReader) -> None:
        self._packed = packed
        self._gzip = gzip.GzipFile(fileobj=packed)
        self._count = 0  # bytes unpacked

    def readable(self) -> bool:
        """Return True: the stream is readable."""
        return True

    def readinto(self, buffer: "bytearray | memoryview") -> int:  # type: ignore[override]  # as typeshed's subclasses
        """Unpack into ``buffer``; returns the number of bytes, 0 at the end."""
        data = self._gzip.read(len(buffer))
        buffer[: len(data)] = data
        self._count += len(data)
        if self._count > max(UNSUSPECTED, MAX_RATIO * self._packed.tell()):
            raise OSError(errno.EFBIG, f"unpacks to over {MAX_RATIO} times its size")
        return len(data)


class Source:
    """Open log file; a context manager."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        self._size = max(os.fstat(self._file.fileno()).st_size, 1)
        self.position = 0  # offset of the next byte in the unpacked log [bytes]
        packed = path.suffix.lower() == ".gz"
        self.stream: io.BufferedReader[Any] = io.BufferedReader(Unpacked(self._file), PIECE) if packed else self._file

    def __enter__(self) -> "Source":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.stream.close()
        self._file.close()

    @property
    def consumed(self) -> float:
        """Share of the file that has been read, 0 to 1; 1 once it is closed."""
        return 1.0 if self._file.closed else min(self._file.tell() / self._size, 1.0)

    def read(self, count: int) -> bytes:
        """Read ``count`` bytes, or fewer only at the end of the log."""
        pieces: list[bytes] = []
        while count > 0 and (piece := self.stream.read(min(count, PIECE))):
            pieces.append(piece)
            count -= len(piece)
            self.position += len(piece)
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

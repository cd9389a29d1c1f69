"""The bytes of a log file, unpacked where the file is gzipped, and how much of it has been read."""

import gzip
import os
from io import BufferedReader, BytesIO
from pathlib import Path
from types import TracebackType

Stream = BufferedReader | gzip.GzipFile
PIECE = 1 << 20  # bytes asked for at once, so that a bogus length reserves no memory


class Source:
    """An open log file; a context manager."""

    def __init__(self, path: Path) -> None:
        self._file = path.open("rb")
        self._size = max(os.fstat(self._file.fileno()).st_size, 1)
        self.stream: Stream = gzip.GzipFile(fileobj=self._file) if path.suffix.lower() == ".gz" else self._file

    def __enter__(self) -> "Source":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.stream.close()
        self._file.close()

    @property
    def position(self) -> int:
        """Offset of the next byte in the unpacked log [bytes]."""
        return self.stream.tell()

    @property
    def consumed(self) -> float:
        """Share of the file that has been read, 0 to 1; 1 once it is closed."""
        return 1.0 if self._file.closed else min(self._file.tell() / self._size, 1.0)

    def read(self, count: int) -> bytes:
        """Read ``count`` bytes, or fewer only where the log ends."""
        if count <= PIECE:
            return self.stream.read(count)
        pieces = BytesIO()
        while count > 0:
            piece = self.stream.read(min(count, PIECE))
            if not piece:
                break
            pieces.write(piece)
            count -= len(piece)
        return pieces.getvalue()

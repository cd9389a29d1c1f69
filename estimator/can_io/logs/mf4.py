"""ASAM MDF 4 bus logs: sorted or unsorted, packed or not, finalised or left open at a loss of power."""

import shutil
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from tempfile import TemporaryFile
from typing import BinaryIO

from estimator.can_io.frames import Frames
from estimator.can_io.logs.channels import Channels
from estimator.can_io.logs.log import GIVE_COLUMNS, Log
from estimator.can_io.logs.mdf.blocks import BadMdfError, MdfFile, UnreadMdfError
from estimator.can_io.logs.mdf.groups import DataGroup, FrameGroup, data_groups, start_time
from estimator.can_io.logs.mdf.merging import merged
from estimator.can_io.logs.mdf.sorted_frames import (
    ROWS,
    RecordStream,
    Streams,
    ValueStream,
    record_count,
    sorted_frames,
)
from estimator.can_io.logs.mdf.stream import Chunk, Tail, chunks
from estimator.can_io.logs.mdf.unsorted_frames import UnsortedStream
from estimator.can_io.logs.source import PIECE, Source
from estimator.errors import LogError

FINISHED, UNFINISHED = b"MDF     ", b"UnFinMF "  # what a file begins with
IDENTIFICATION = 64  # bytes
VERSION_AT, OPEN_AT = slice(28, 30), slice(60, 62)  # bytes of the identification: version, what was left open
VERSIONS = range(400, 500)
OPEN_COUNTS, OPEN_SIZE, OPEN_LINKS, OPEN_OFFSETS = 1, 4, 16, 64  # flags of what was left open
MAX_UNPACKED = 1 << 26  # bytes of packed blocks that are held at once, over all streams
MIN_UNPACKED = 1 << 22  # bytes of a packed block that can always be read; writers make none larger
MAX_STREAMS = 64  # of frames, each of which holds a block: 4 MiB unpacked at the most


class Mf4Log(Log):
    """Log in ``.mf4`` format; times are those of python-can's ``MF4Reader``."""

    def _read(self) -> Iterator[Frames]:
        with self._unpacked() as opened:
            file = MdfFile(opened)
            flags = self._read_identification(file)
            count = 0
            try:
                content = Content(file, flags, self.skipped, self.channels)
                if not content.has_frames:
                    raise LogError(
                        f"{self.path}: no CAN frames in it, only other values; give the log of the bus, or, if they "
                        f"are decoded signals, {GIVE_COLUMNS}"
                    )
                for frames in merged(content.streams):
                    count += len(frames)
                    self.progress = min(file.consumed / file.size, 1.0)
                    yield frames
            except UnreadMdfError as error:
                raise LogError(f"{self.path}: {error}, at byte {error.offset}; {error.remedy}") from error
            except BadMdfError as error:
                raise LogError(
                    f"{self.path}: damaged or cut at byte {error.offset} ({error}) after {count} frames; copy it anew"
                ) from error

    @contextmanager
    def _unpacked(self) -> Iterator[BinaryIO]:
        """Open the file; a gzipped one is unpacked to a temporary file, because its blocks refer to each other."""
        with ExitStack() as stack:
            if self.path.suffix.lower() != ".gz":
                yield stack.enter_context(self.path.open("rb"))
                return
            source, file = stack.enter_context(Source(self.path)), stack.enter_context(TemporaryFile())
            shutil.copyfileobj(source.stream, file, PIECE)
            file.flush()
            yield file

    def _read_identification(self, file: MdfFile) -> int:
        """Read the flags of parts that the writer left open."""
        raw = file.bytes_at(0, IDENTIFICATION)
        if not raw.startswith((FINISHED, UNFINISHED)):
            raise LogError(f"{self.path}: not an MF4 log (it does not begin with MDF); check what the file is")
        if len(raw) < IDENTIFICATION:
            raise LogError(f"{self.path}: cut at byte {len(raw)}, inside the identification; 0 frames can be read")
        version = int.from_bytes(raw[VERSION_AT], "little")
        if version not in VERSIONS:
            raise LogError(f"{self.path}: of MDF version {version / 100:.2f}; convert it to version 4")
        flags = int.from_bytes(raw[OPEN_AT], "little") if raw.startswith(UNFINISHED) else 0
        if flags & OPEN_OFFSETS:
            raise LogError(
                f"{self.path}: its logger never wrote where payloads are; finalize it with the logger's tool"
            )
        return flags


class Content:
    """Contents of a file: ``streams`` of the frames on read channels; ``has_frames`` if it can hold any.

    Frames without data are counted by kind in ``skipped``.

    Raises
    ------
    BadMdfError
        The file is damaged, or frames are stored in an unknown way.
    """

    def __init__(self, file: MdfFile, flags: int, skipped: Counter[str], channels: Channels) -> None:
        self._file = file
        self._channels = channels
        self._has_counts = not flags & OPEN_COUNTS
        self._is_cut = flags != 0
        self._tail = Tail(size=bool(flags & OPEN_SIZE), links=bool(flags & OPEN_LINKS))
        self._skipped = skipped
        self._start = start_time(file)
        self._data_groups = data_groups(file)
        every = [data_group for data_group in self._data_groups if any(group.frames for group in data_group.groups)]
        self.has_frames = bool(every)
        wanted = [data_group for data_group in every if self._holds_frames(data_group)]
        if len(wanted) > MAX_STREAMS:
            reason = f"{len(wanted)} streams of CAN frames, of which {MAX_STREAMS} can be read at once"
            raise UnreadMdfError(wanted[-1].address, reason)
        self._most = ROWS // max(len(wanted), 1)
        self._largest = max(MAX_UNPACKED // max(len(wanted), 1), MIN_UNPACKED)
        self.streams = [self._frames(data_group) for data_group in wanted]
        for data_group in self._data_groups:
            for group in data_group.groups if data_group.id_bytes == 0 else ():
                if group.skipped and group.record_bytes:
                    there = record_count(self._chunks(data_group.data), group.record_bytes)
                    skipped[group.skipped] += min(there, group.count) if self._has_counts else there

    def _holds_frames(self, data_group: DataGroup) -> bool:
        """True if its records may contain a frame: finalised files list groups that are empty."""
        if not self._has_counts:
            return data_group.data != 0
        return any(group.frames is not None and group.count for group in data_group.groups)

    def _chunks(self, address: int) -> Iterator[Chunk]:
        return chunks(self._file, address, self._tail, self._largest)

    def _frames(self, data_group: DataGroup) -> Iterator[Frames]:
        if data_group.id_bytes:
            data = self._chunks(data_group.data)
            stream = UnsortedStream(data_group, data, self._channels, self._start, self._is_cut)
            return stream.frames(self._skipped)
        (group,) = data_group.groups
        assert group.frames is not None
        count = group.count if self._has_counts else None
        values = group.frames.data.values
        streams = Streams(
            records=RecordStream(self._chunks(data_group.data), group.record_bytes),
            masters=self._masters(group.frames) if group.frames.times_at != group.address else None,
            values=ValueStream(self._chunks(values), values) if values else None,
        )
        return sorted_frames(group.frames, streams, self._channels, count, self._start, self._most, self._skipped)

    def _masters(self, frames: FrameGroup) -> RecordStream:
        """Records with the times of a group."""
        for data_group in self._data_groups:
            for group in data_group.groups:
                if group.address == frames.times_at and data_group.id_bytes == 0:
                    if group.record_bytes < frames.times.field.end:
                        raise BadMdfError(group.address, f"times in records of {group.record_bytes} bytes")
                    return RecordStream(self._chunks(data_group.data), group.record_bytes)
        raise UnreadMdfError(frames.address, "CAN frames whose times are among other records")

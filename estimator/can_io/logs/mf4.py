"""ASAM MDF4 bus logs, read by python-can with asammdf."""

import struct
from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from traceback import walk_tb

import can

from estimator.can_io.frames import Frames
from estimator.can_io.logs.messages import MessageLog
from estimator.errors import LogError

MAGIC = (b"MDF     ", b"UnFinMF ")  # finished, or left open by a logger that lost power


class Mf4Log(MessageLog):
    """An ``.mf4`` log; needs the extra ``mf4``."""

    def _read(self) -> Iterator[Frames]:
        with self.path.open("rb") as file:
            if file.read(8) not in MAGIC:
                raise LogError(f"{self.path}: not an MF4 log (it does not begin with MDF); check what the file is")
        if find_spec("asammdf") is None:
            raise LogError(f"{self.path}: to read MF4 logs, pip install 'roadload[mf4]'")
        count = 0
        try:
            with can.MF4Reader(self.path) as reader:
                groups = reader._mdf.groups  # python-can does not tell the number of frames
                total = max(sum(group.channel_group.cycles_nr for group in groups), 1)
                for frames in self._pack(reader):
                    count += len(frames)
                    self.progress = min(count / total, 1.0)
                    yield frames
        except _errors() as error:
            _release(error)
            reason = " ".join(str(error).split()) or type(error).__name__
            raise LogError(f"{self.path}: damaged or cut ({reason}) after {count} frames; copy it anew") from error


def _errors() -> tuple[type[Exception], ...]:
    """Give what asammdf was seen to raise at damaged files."""
    own = (import_module("asammdf.blocks.utils").MdfException, import_module("isal.isal_zlib").error, struct.error)
    return (*own, ValueError, LookupError, TypeError, OverflowError, MemoryError, NameError, AttributeError)


def _release(error: BaseException) -> None:
    """Close what a failed constructor left open; asammdf's ``__del__`` would trip over what is not there yet."""
    for frame, _ in walk_tb(error.__traceback__):
        half_built = frame.f_locals.get("self")
        if isinstance(half_built, can.MF4Reader):
            half_built.file.close()
        elif type(half_built).__name__ == "MDF4":
            for name in ("_file", "header", "identification"):
                if not hasattr(half_built, name):
                    setattr(half_built, name, None)

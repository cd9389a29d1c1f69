"""ASAM MDF4 bus logs, read by python-can with asammdf."""

from collections.abc import Iterator
from importlib.util import find_spec

import can

from estimator.can_io.frames import Frames
from estimator.can_io.logs.messages import MessageLog
from estimator.errors import LogError


class Mf4Log(MessageLog):
    """An ``.mf4`` log; needs the extra ``mf4``."""

    def _read(self) -> Iterator[Frames]:
        if find_spec("asammdf") is None:
            raise LogError(f"{self.path}: to read MF4 logs, pip install 'roadload[mf4]'")
        with can.MF4Reader(self.path) as reader:
            yield from self._pack(reader)

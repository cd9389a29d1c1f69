"""Our own frames that a bus gives back: a multicast group does to everybody, a CAN controller does not."""

import threading
from collections import deque

import can
import numpy as np

from estimator.can_io.frames import EXTENDED, Frames

MAX_ECHOES = 100  # frames that may still come back


class Echoes:
    """Stores the sent messages, in one thread, and separates them from the received ones, in another."""

    def __init__(self) -> None:
        self._sent: deque[tuple[int, bytes]] = deque(maxlen=MAX_ECHOES)
        self._lock = threading.Lock()

    def expect(self, message: can.Message) -> None:
        """Remember a message on its way out."""
        with self._lock:
            self._sent.append((message.arbitration_id | EXTENDED, bytes(message.data)))

    def split(self, frames: Frames) -> tuple[Frames, Frames]:
        """Frames of others, and those that were sent, each of which can come back once."""
        keep = np.ones(len(frames), dtype=bool)
        with self._lock:
            for i in np.flatnonzero(np.isin(frames.ident, [ident for ident, _ in self._sent])).tolist():
                echo = (int(frames.ident[i]), frames.data[i, : frames.length[i]].tobytes())
                if echo in self._sent:
                    self._sent.remove(echo)
                    keep[i] = False
        return frames[keep], frames[~keep]

"""A bus that gives recorded messages, and then fails."""

import threading
from collections.abc import Iterator

import can


class PlayedBus(can.BusABC):
    """Gives messages, then fails three times."""

    def __init__(self, messages: Iterator[can.Message]) -> None:
        super().__init__(channel="played")
        self.has_failed = threading.Event()
        self.sent: list[can.Message] = []
        self._messages, self._failures = messages, 3

    def recv(self, timeout: float | None = None) -> can.Message | None:
        message = next(self._messages, None)
        if message is not None:
            return message
        if self._failures:
            self._failures -= 1
            raise can.CanOperationError("Network is down")
        self.has_failed.set()
        return None

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        self.sent.append(msg)

"""A bounded queue of frames between two threads of the daemon."""

import threading
from collections import deque
from typing import Generic, TypeVar

T = TypeVar("T")


class Inbox(Generic[T]):
    """A bounded queue of things that hold frames: when it is full the newest are dropped, as the kernel does.

    One that holds more frames than fit is taken where nothing waits.
    """

    def __init__(self, most: int) -> None:
        self.waiting = self.dropped = 0  # frames
        self._most = most
        self._items: deque[T] = deque()
        self._condition = threading.Condition()
        self._closed = False

    def offer(self, item: T, frames: int) -> None:
        """Put in an item that holds so many ``frames``, or drop it whole."""
        with self._condition:
            if self._items and self.waiting + frames > self._most:
                self.dropped += frames
                return
            self._items.append(item)
            self.waiting += frames
            self._condition.notify()

    def take(self) -> list[T]:
        """Everything that waits, oldest first."""
        with self._condition:
            items = list(self._items)
            self._items.clear()
            self.waiting = 0
        return items

    def wait(self, timeout: float) -> bool:
        """Wait up to ``timeout`` [s] for something to take; False once the inbox is closed."""
        with self._condition:
            if not self._items and not self._closed:
                self._condition.wait(timeout)
            return not self._closed

    def close(self) -> None:
        """End all waiting."""
        with self._condition:
            self._closed = True
            self._condition.notify()

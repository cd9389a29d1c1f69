"""Notifications to systemd: `sd_notify(3)` over its datagram socket; without systemd, none are sent."""

import os
import socket
import time
from contextlib import suppress


class Notifier:
    """Sends states to the service manager named by ``NOTIFY_SOCKET``."""

    def __init__(self) -> None:
        path = os.environ.get("NOTIFY_SOCKET", "")
        self._address = "\0" + path[1:] if path.startswith("@") else path

    def send(self, *states: str) -> None:
        """Send assignments such as ``READY=1``; errors of the socket are ignored."""
        if not self._address:
            return
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as manager, suppress(OSError):
            manager.sendto("\n".join(states).encode(), self._address)

    def reloading(self) -> None:
        """Say that the configuration is being read again; ``READY=1`` ends it."""
        self.send("RELOADING=1", f"MONOTONIC_USEC={time.clock_gettime_ns(time.CLOCK_MONOTONIC) // 1000}")

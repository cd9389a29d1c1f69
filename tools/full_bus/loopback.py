"""A stand-in for SocketCAN on hosts without it: python-can's own SocketCAN bus over a UDP socket on the loopback.

A datagram is one ``struct can_frame``. System calls, batches, kernel time stamps, receive buffer and the kernel's count
of dropped frames are those of a raw CAN socket; the driver and the CAN layer below it are missing.
"""

import socket
import threading
from typing import Any

import can
import can.interfaces
import can.util
from can.interfaces.socketcan import SocketcanBus

HOST = "127.0.0.1"
NAME = "loopback"
TIMESTAMPS = 35  # SO_TIMESTAMPNS


class _Socket(socket.socket):
    """A socket that reports the family AF_CAN."""

    @property
    def family(self) -> socket.AddressFamily:
        return socket.AF_CAN


class LoopbackBus(SocketcanBus):
    """``channel`` is the UDP port; the sender applies the filters, as the kernel does on a real bus."""

    def __init__(self, channel: str, can_filters: Any = None, **options: Any) -> None:
        self.socket = _Socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.setsockopt(socket.SOL_SOCKET, TIMESTAMPS, 1)
        self.socket.bind((HOST, int(channel)))
        self.channel = str(channel)
        self.channel_info = f"loopback port {channel}"
        self._bcm_sockets: dict[str, socket.socket] = {}
        self._is_filtered = True
        self._task_id, self._task_id_guard = 0, threading.Lock()
        self._can_protocol = can.CanProtocol.CAN_20
        can.BusABC.__init__(self, channel=channel)

    def _apply_filters(self, filters: Any) -> None:
        self._is_filtered = True


def register() -> None:
    """Register ``-i loopback`` with python-can in this process."""
    can.interfaces.BACKENDS[NAME] = (__name__, LoopbackBus.__name__)
    for module in (can, can.util):
        vars(module)["VALID_INTERFACES"] = frozenset(can.interfaces.BACKENDS)

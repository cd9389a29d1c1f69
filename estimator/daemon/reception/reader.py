"""Draining a bus in batches: one wake-up of the process brings many frames.

python-can hands out one message at a time, for some 30 to 70 us each; a full bus of 500 kbit/s has 3,800 a second.
Where it has opened a SocketCAN socket the frames are read from that socket and unpacked all at once. Other interfaces
are drained through `can.BusABC.recv`.
"""

import select
import socket
import struct
import time
from dataclasses import dataclass, field, replace
from typing import Protocol

import can
import numpy as np
from can.interfaces.udp_multicast import UdpMulticastBus

from estimator.can_io.frames import CLASSIC_BYTES, FD_BYTES, Frames
from estimator.can_io.logs.messages import check_message
from estimator.signals import Floats, Mask

GATHER_TIME = 0.01  # s for which frames gather in the kernel after the first: 100 wake-ups a second at most
MAX_BATCH = 4096  # frames
CLASSIC_FRAME, FD_FRAME = 16, 72  # bytes of struct can_frame and struct canfd_frame (linux/can.h)
REMOTE, ERROR = 1 << 30, 1 << 29  # bits of the id (linux/can.h)
CONFIRM = 0x800  # flag of a message that this very socket sent (MSG_CONFIRM)
BUS_OFF = 0x40  # class of an error frame, bit of its id (linux/can/error.h)
MEMORY_INFO, DROPS = 55, 8  # socket option SO_MEMINFO and its counter of dropped frames (linux/sock_diag.h)
FORCED_BUFFER = 33  # SO_RCVBUFFORCE: beyond net.core.rmem_max, for the privileged
TIMESTAMP = 35  # SO_TIMESTAMPNS
LONG = np.dtype("l")
NO_STAMP = bytes(2 * LONG.itemsize)  # struct timespec: seconds and nanoseconds


@dataclass(frozen=True, slots=True, kw_only=True)
class Batch:
    """Data frames that were drained at once, and the number of other frames."""

    frames: Frames = field(default_factory=lambda: Frames.from_messages([]))
    own: Frames = field(default_factory=lambda: Frames.from_messages([]))  # that we sent, and that have been on the bus
    errors: int = 0  # error frames
    bus_off: int = 0  # those among them that report "bus off"
    remote: int = 0
    malformed: int = 0  # not what a bus can carry


class Reader(Protocol):
    """Takes what has come in on a bus."""

    def read(self, timeout: float) -> Batch:
        """Wait up to ``timeout`` [s] for a frame, then take all there are.

        Raises
        ------
        OSError, can.CanError
            The bus has gone.
        """

    def kernel_drops(self) -> int:
        """Frames lost in the kernel since the bus was opened."""

    def buffer_bytes(self) -> int | None:
        """Size of the receive buffer [bytes], None where it is not known."""

    def is_confirming(self) -> bool:
        """Whether frames that we send come back as ``own`` once they have been on the bus."""


def reader_of(bus: can.BusABC, buffer_bytes: int) -> Reader:
    """The fastest reader for this kind of bus; the receive buffer is made ``buffer_bytes`` large where possible."""
    sock = getattr(bus, "socket", None)
    if isinstance(sock, socket.socket) and sock.family == getattr(socket, "AF_CAN", None):
        return SocketReader(sock, buffer_bytes)
    return MessageReader(bus)


class SocketReader:
    """Reads ``struct can_frame`` from the socket of a python-can SocketCAN bus, which has time stamps enabled."""

    def __init__(self, sock: socket.socket, buffer_bytes: int) -> None:
        self._socket = sock
        self._failure: OSError | None = None
        self._poll = select.poll()
        self._poll.register(sock, select.POLLIN)
        try:
            sock.setsockopt(socket.SOL_SOCKET, FORCED_BUFFER, buffer_bytes)
        except OSError:  # not privileged: as far as net.core.rmem_max allows
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, buffer_bytes)
        try:
            sock.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_RECV_OWN_MSGS, 1)
            self._confirms = True
        except OSError:  # a stand-in for a CAN socket
            self._confirms = False

    def read(self, timeout: float) -> Batch:
        """Wait up to ``timeout`` [s] for a frame, then take all there are.

        Raises
        ------
        OSError
            The socket failed; frames read before the failure were returned by the call before.
        """
        if self._failure is not None:
            raise self._failure
        if not self._poll.poll(timeout * 1000):
            return Batch()
        time.sleep(GATHER_TIME)
        raw: list[bytes] = []
        stamps: list[bytes] = []
        flags: list[int] = []
        receive, ancillary_bytes = self._socket.recvmsg, socket.CMSG_SPACE(len(NO_STAMP))
        try:
            while len(raw) < MAX_BATCH:
                data, ancillary, flag, _ = receive(FD_FRAME, ancillary_bytes, socket.MSG_DONTWAIT)
                raw.append(data)
                flags.append(flag)
                stamps.append(ancillary[0][2] if ancillary and ancillary[0][1] == TIMESTAMP else NO_STAMP)
        except BlockingIOError:
            pass
        except OSError as error:
            if not raw:
                raise
            self._failure = error  # told once and no more by the kernel; what came before it counts
        if not raw:  # the socket had an error to tell, which a sender was told meanwhile
            return Batch()
        t = np.frombuffer(b"".join(stamps), dtype=LONG).reshape(-1, 2) @ np.array([1.0, 1e-9])
        return unpack(raw, t, np.array(flags) & CONFIRM != 0)

    def kernel_drops(self) -> int:
        """Frames lost in the kernel since the bus was opened."""
        info = self._socket.getsockopt(socket.SOL_SOCKET, MEMORY_INFO, 4 * (DROPS + 1))
        drops: int = struct.unpack_from("=I", info, 4 * DROPS)[0]
        return drops

    def buffer_bytes(self) -> int | None:
        """Size of the receive buffer as the kernel counts it, which is twice what it was asked for (socket(7))."""
        return self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)

    def is_confirming(self) -> bool:
        """Whether this is a CAN socket, which marks our own frames."""
        return self._confirms


def unpack(raw: list[bytes], t: Floats, own: Mask) -> Batch:
    """Frames as the kernel hands them out (linux/can.h), stamped ``t`` (n,) [s]; those we sent are ``own`` (n,)."""
    sizes = {len(one) for one in raw}
    width = CLASSIC_BYTES if sizes <= {CLASSIC_FRAME} else FD_BYTES
    packed = b"".join(raw if width == CLASSIC_BYTES else [one[:FD_FRAME].ljust(FD_FRAME, b"\0") for one in raw])
    layout = np.dtype([("ident", "=u4"), ("length", "u1"), ("other", "u1", 3), ("data", "u1", width)])
    frames = np.frombuffer(packed, dtype=layout)
    ident, length = frames["ident"], frames["length"]
    error = ident & ERROR != 0
    remote = ~error & (ident & REMOTE != 0)
    capacity = np.array([len(one) for one in raw]) - 8
    good = ~error & ~remote & (length <= capacity)
    # The kernel leaves bits beyond a standard id clear; what lies beyond the length is undefined.
    data = np.where(np.arange(width) < length[:, None], frames["data"], 0).astype(np.uint8)
    found = Frames(t, ident, length, data)
    return Batch(
        frames=found[good & ~own],
        own=found[good & own],
        errors=int(error.sum()),
        bus_off=int((error & (ident & BUS_OFF != 0)).sum()),
        remote=int(remote.sum()),
        malformed=int((~error & ~remote & ~good).sum()),
    )


class MessageReader:
    """Drains any python-can bus, message by message."""

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._takes_datagrams = isinstance(bus, UdpMulticastBus)

    def read(self, timeout: float) -> Batch:
        """Wait up to ``timeout`` [s] for a frame, then take all there are."""
        message, malformed = self._receive(timeout)
        if message is None:
            return Batch(malformed=malformed)
        time.sleep(GATHER_TIME)
        messages: list[can.Message] = []
        while message is not None and len(messages) + malformed < MAX_BATCH:
            messages.append(message)
            message, more = self._receive(0)
            malformed += more
        if message is not None:
            messages.append(message)
        return replace(batch := pack(messages), malformed=batch.malformed + malformed)

    def kernel_drops(self) -> int:
        """0: python-can does not report them."""
        return 0

    def buffer_bytes(self) -> int | None:
        """Not known."""
        return None

    def is_confirming(self) -> bool:
        """Not known of most interfaces, so never."""
        return False

    def _receive(self, timeout: float) -> tuple[can.Message | None, int]:
        """The next message, and the number of datagrams or damaged lines of a serial adapter before it.

        Raises
        ------
        can.CanOperationError
            There is nothing but damaged lines.
        """
        malformed = 0
        while malformed < MAX_BATCH:
            try:
                return self._bus.recv(timeout), malformed
            except can.CanOperationError as error:
                if not self._takes_datagrams or isinstance(error.__cause__, OSError | None):
                    raise
            except ValueError as error:  # python-can reads numbers of a line without a check
                if malformed + 1 == MAX_BATCH:
                    raise can.CanOperationError(f"damaged lines only: {error}") from error
            malformed, timeout = malformed + 1, 0
        return None, malformed


def pack(messages: list[can.Message]) -> Batch:
    """Messages sorted into data frames and the rest."""
    data: list[can.Message] = []
    errors = bus_off = remote = malformed = 0
    for message in messages:
        if message.is_error_frame:
            errors += 1
            bus_off += bool(message.arbitration_id & BUS_OFF)
        elif message.is_remote_frame:
            remote += 1
        else:
            try:
                check_message(message)
            except ValueError:
                malformed += 1
                continue
            data.append(message)
    return Batch(frames=Frames.from_messages(data), errors=errors, bus_off=bus_off, remote=remote, malformed=malformed)

"""The receiving end on a real stack: filters, overflow, and interfaces that go and come back."""

import socket
import struct
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import can
import numpy as np
import pytest
from conftest import ip

from estimator.can_io.binding import bind, load_database
from estimator.config import Config
from estimator.daemon.reception.buses import BusSpec, open_bus
from estimator.daemon.reception.filters import input_filters
from estimator.daemon.reception.link import Link
from estimator.daemon.reception.reader import reader_of
from estimator.errors import ConfigError
from estimator.settings import Reception

# python-can leaves the socket of an attempt that failed to the garbage collector.
pytestmark = [pytest.mark.nightly, pytest.mark.filterwarnings("ignore:unclosed <socket:ResourceWarning")]

LONGEST = 20.0  # s for anything here to happen; the machine is slow
CCVS1 = 0x18FEF100
UNWANTED = 0x18FEF200  # LFE1, fuel economy


@contextmanager
def raw(channel: str) -> Iterator[socket.socket]:
    """A socket to send from, quicker than python-can."""
    with socket.socket(socket.PF_CAN, socket.SOCK_RAW, socket.CAN_RAW) as sender:
        sender.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FILTER, b"")
        sender.bind((channel,))
        yield sender


def frame(ident: int, number: int = 0) -> bytes:
    return struct.pack("=IB3xQ", ident | socket.CAN_EFF_FLAG, 8, number)


def spec(channel: str) -> BusSpec:
    return BusSpec({"interface": "socketcan", "channel": channel})


@contextmanager
def linked(channel: str) -> Iterator[Link]:
    link = Link(spec(channel), None, Reception())
    link.start()
    try:
        yield link
    finally:
        link.close()


def wait_for(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + LONGEST
    while not condition():
        assert time.monotonic() < deadline, f"waited {LONGEST:g} s for: {what}"
        time.sleep(0.02)


def read_all(reader) -> list[int]:
    """First data word of everything that waits."""
    words: list[int] = []
    while len(batch := reader.read(0.5).frames):
        words += batch.data[:, :8].copy().view("<u8").ravel().tolist()
    return words


def test_the_kernel_lets_only_wanted_groups_through(buses):
    """A small buffer holds every wanted frame, because the unwanted never reach it."""
    wanted = bind(Config(), load_database([]))
    with open_bus(spec(buses[0]), input_filters(wanted)) as bus, raw(buses[0]) as sender:
        reader = reader_of(bus, 16_384)
        keys = {message.key for message in wanted if message.by_pgn}
        for k in range(2000):
            sender.send(frame(UNWANTED, k))
        for priority, source in ((6, 0x00), (3, 0x31), (0, 0xFE)):
            sender.send(frame(priority << 26 | 0xFEF1 << 8 | source, source))
        batch = reader.read(LONGEST)
        assert 0xFEF2 not in keys
        assert batch.frames.ident.tolist() == [CCVS1 | 1 << 31, 0x0CFEF131 | 1 << 31, 0x00FEF1FE | 1 << 31]
        assert reader.kernel_drops() == 0


def test_transport_packets_pass_the_filter(buses):
    with open_bus(spec(buses[0]), input_filters(bind(Config(), load_database([])))) as bus, raw(buses[0]) as sender:
        reader = reader_of(bus, 65_536)
        sent = [0x1CECFF00, 0x1CEBFF00, 0x1CEC2A00]  # the last is between two others, and joined while listening
        for ident in (*sent, 0x18EA2A00):
            sender.send(frame(ident))
        assert (reader.read(LONGEST).frames.ident & 0x1FFFFFFF).tolist() == sent


def test_every_frame_lost_in_the_kernel_is_counted(buses):
    count = 5000
    with open_bus(spec(buses[0]), None) as bus, raw(buses[0]) as sender:
        reader = reader_of(bus, 100_000)
        for k in range(count):
            sender.send(frame(CCVS1, k))
        kept = read_all(reader)
        assert 0 < len(kept) < count
        assert reader.kernel_drops() == count - len(kept)
        assert kept == list(range(len(kept)))  # the newest are lost, none is out of order


def test_the_receive_buffer_is_as_large_as_asked_for(buses):
    with open_bus(spec(buses[0]), None) as bus, raw(buses[0]) as sender:
        reader = reader_of(bus, Reception().buffer_bytes)
        for k in range(5000):
            sender.send(frame(CCVS1, k))
        assert read_all(reader) == list(range(5000))
        assert reader.kernel_drops() == 0


def test_frames_carry_the_kernels_time(buses):
    with open_bus(spec(buses[0]), None) as bus, raw(buses[0]) as sender:
        reader = reader_of(bus, 65_536)
        before = time.time()
        sender.send(frame(CCVS1))
        sender.send(frame(CCVS1))
        after = time.time()
        stamps = reader.read(LONGEST).frames.t
        assert len(stamps) == 2
        assert before - 1e-3 <= stamps[0] <= stamps[1] <= after + 1e-3


@pytest.mark.parametrize("anew", [False, True], ids=["down and up", "deleted and made anew"])
def test_reception_and_transmission_come_back_with_the_interface(buses, anew):
    channel = buses[0]
    with linked(channel) as link:
        wait_for(lambda: link.is_open, "the bus to open")
        with raw(channel) as sender:
            sender.send(frame(CCVS1, 1))
        wait_for(lambda: link.counts.frames == 1, "a frame")
        if anew:
            ip("delete", "dev", channel)
            wait_for(lambda: not link.is_open, "the loss to be seen")
            ip("add", "dev", channel, "type", "vcan")
        else:
            ip("set", "dev", channel, "down")
            wait_for(lambda: not link.is_open or not link.is_up, "the loss to be seen")
        ip("set", "dev", channel, "up")
        wait_for(lambda: link.is_open and link.is_up, "the bus to open again")
        assert link.counts.reopened >= anew
        with raw(channel) as sender, can.Bus(interface="socketcan", channel=channel, ignore_config=True) as peer:
            sender.send(frame(CCVS1, 2))
            wait_for(lambda: link.counts.frames == 2, "a frame after the interface has come back")
            assert peer.recv(LONGEST).arbitration_id == CCVS1
            link.send(can.Message(arbitration_id=0x18FF60FB, data=bytes(8)))
            assert peer.recv(LONGEST).arbitration_id == 0x18FF60FB
        numbers = np.concatenate([batch.frames.data[:, 0] for _, batch in link.take()])
        assert numbers.tolist() == [1, 2]


def test_an_interface_made_anew_between_two_looks_is_noticed(buses):
    """The old socket hears nothing for ever and says so only once."""
    with linked(buses[0]) as link:
        wait_for(lambda: link.is_open, "the bus to open")
        ip("delete", "dev", buses[0])
        ip("add", "dev", buses[0], "type", "vcan")
        ip("set", "dev", buses[0], "up")
        wait_for(lambda: link.counts.reopened == 1 and link.is_open, "the bus to open again")
        with raw(buses[0]) as sender:
            sender.send(frame(CCVS1))
        wait_for(lambda: link.counts.frames == 1, "a frame from the new interface")


def test_the_bus_is_opened_when_its_interface_appears(buses):
    ip("delete", "dev", buses[0])
    with linked(buses[0]) as link:
        wait_for(lambda: link.counts.attempts_failed > 0, "an attempt")
        ip("add", "dev", buses[0], "type", "vcan")
        ip("set", "dev", buses[0], "up")
        wait_for(lambda: link.is_open, "the bus to open")
        with raw(buses[0]) as sender:
            sender.send(frame(CCVS1))
        wait_for(lambda: link.counts.frames == 1, "a frame")


def test_an_interface_that_is_no_can_interface_is_refused():
    with pytest.raises(ConfigError, match="is not a CAN interface"):
        open_bus(spec("lo"), None)

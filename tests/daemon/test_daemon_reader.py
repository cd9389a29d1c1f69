"""Draining: the kernel's frames, unpacked in batches, are those that python-can would have given."""

import socket
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import can
import numpy as np
import pytest
from can.interfaces.socketcan.socketcan import build_can_frame
from hypothesis import given
from hypothesis import strategies as st

from estimator import config
from estimator.can_io.binding import bind, load_database
from estimator.can_io.decoder import Decoder
from estimator.can_io.frames import EXTENDED, Frames
from estimator.can_io.publisher import output_groups
from estimator.config import Config
from estimator.daemon.reception.filters import input_filters, node_filters
from estimator.daemon.reception.reader import TIMESTAMP, MessageReader, SocketReader, reader_of, unpack
from estimator.settings import Bus

MESSAGES = st.builds(
    lambda extended, ident, data: can.Message(
        arbitration_id=ident if extended else ident & 0x7FF, is_extended_id=extended, data=data, is_fd=len(data) > 8
    ),
    st.booleans(),
    st.integers(0, 0x1FFFFFFF),
    st.binary(max_size=8) | st.sampled_from([12, 16, 20, 24, 32, 48, 64]).map(lambda n: bytes(range(n))),
)


NONE = np.zeros(20, dtype=bool)  # frames that we sent ourselves


@given(st.lists(MESSAGES, min_size=1, max_size=20))
def test_frames_of_the_kernel_are_unpacked_as_python_can_packs_them(messages: list[can.Message]) -> None:
    t = np.arange(len(messages), dtype=np.float64)
    batch = unpack([build_can_frame(message) for message in messages], t, NONE[: len(t)])
    assert batch.malformed == batch.errors == batch.remote == 0
    for message, found in zip(messages, batch.frames.messages(), strict=True):
        assert found.arbitration_id == message.arbitration_id
        assert found.is_extended_id == message.is_extended_id
        assert found.data == message.data
    np.testing.assert_array_equal(batch.frames.t, t)


@pytest.mark.slow
@given(st.lists(st.binary(min_size=16, max_size=16) | st.binary(min_size=72, max_size=72), max_size=20))
def test_any_bytes_are_sorted_and_counted(raw: list[bytes]) -> None:
    batch = unpack(raw, np.zeros(len(raw)), NONE[: len(raw)])
    assert len(batch.frames) + batch.errors + batch.remote + batch.malformed == len(raw)
    beyond = np.arange(batch.frames.data.shape[1]) >= batch.frames.length[:, None]
    assert not batch.frames.data[beyond].any()


def test_error_frames_are_told_from_data() -> None:
    raw = [struct.pack("=IB3x8s", ident, 8, bytes(8)) for ident in (0x20000040, 0x20000004, 0x40000123, 0x123)]
    batch = unpack(raw, np.zeros(4), NONE[:4])
    assert (batch.errors, batch.bus_off, batch.remote, len(batch.frames)) == (2, 1, 1, 1)


def test_our_own_frames_are_told_from_those_of_others() -> None:
    raw = [build_can_frame(can.Message(arbitration_id=i, is_extended_id=True)) for i in range(4)]
    batch = unpack(raw, np.arange(4.0), np.array([False, True, False, True]))
    assert batch.frames.t.tolist() == [0.0, 2.0]
    assert batch.own.t.tolist() == [1.0, 3.0]


@pytest.fixture
def pair() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Two ends of datagrams, stamped by the kernel as CAN frames are."""
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    there.setsockopt(socket.SOL_SOCKET, TIMESTAMP, 1)
    yield here, there
    here.close()
    there.close()


def test_a_socket_is_drained_at_once_with_the_stamps_of_the_kernel(pair: tuple[socket.socket, socket.socket]) -> None:
    here, there = pair
    reader = SocketReader(there, 1 << 20)
    for i in range(5):
        here.send(build_can_frame(can.Message(arbitration_id=i, data=[i], is_extended_id=True)))
    batch = reader.read(1.0)
    assert batch.frames.ident.tolist() == [EXTENDED | i for i in range(5)]
    assert (np.diff(batch.frames.t) >= 0).all()
    assert batch.frames.t[0] > 1.7e9
    assert len(reader.read(0.0).frames) == 0
    assert reader.kernel_drops() == 0
    assert (reader.buffer_bytes() or 0) > 4096


class DamagedLines(can.BusABC):
    """A serial adapter that gives ``lines``, one after the other and the last for ever; None is a damaged one."""

    def __init__(self, *lines: can.Message | None) -> None:
        self._lines = list(lines)

    def recv(self, timeout: float | None = None) -> can.Message | None:
        line = self._lines.pop(0) if len(self._lines) > 1 else self._lines[0]
        if line is None:
            raise ValueError("invalid literal for int() with base 16: '0CF0?400'")
        return line

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError

    def shutdown(self) -> None:
        """There is nothing to close."""


def test_damaged_lines_of_a_serial_adapter_are_counted() -> None:
    frame = can.Message(timestamp=1.0, arbitration_id=5, data=[1])
    batch = MessageReader(DamagedLines(None, frame, None, None, frame)).read(0.0)
    assert batch.malformed == 3
    assert len(batch.frames) + batch.malformed > 4000  # a batch: the last line is given for ever
    with pytest.raises(can.CanOperationError, match="damaged lines only"):
        MessageReader(DamagedLines(None)).read(0.0)


def test_what_came_before_a_failure_counts_and_the_failure_is_told_next(monkeypatch: pytest.MonkeyPatch) -> None:
    data = build_can_frame(can.Message(arbitration_id=1))

    class Dying:
        def __init__(self) -> None:
            self.answers = [(data, [], 0, None), OSError(100, "Network is down")]

        def recvmsg(self, *arguments: int) -> object:
            answer = self.answers.pop(0)
            if isinstance(answer, OSError):
                raise answer
            return answer

    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
    with here, there:
        here.send(data)
        reader = SocketReader(there, 1 << 16)
        monkeypatch.setattr(reader, "_socket", Dying())
        assert len(reader.read(1.0).frames) == 1
        with pytest.raises(OSError, match="down"):
            reader.read(1.0)


def test_a_socket_that_has_nothing_after_all_is_no_error(
    pair: tuple[socket.socket, socket.socket], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An error wakes the reader, and the thread that sends is told of it first."""
    here, there = pair
    reader = SocketReader(there, 1 << 16)
    here.send(bytes(16))
    monkeypatch.setattr(time, "sleep", lambda duration: there.recv(16))
    assert len(reader.read(1.0).frames) == 0


def test_other_buses_are_drained_message_by_message() -> None:
    options = {"interface": "virtual", "channel": "test reader", "ignore_config": True}
    with can.Bus(**options) as here, can.Bus(**options) as there:
        reader = reader_of(there, 4096)
        assert isinstance(reader, MessageReader)
        for i in range(10):
            here.send(can.Message(arbitration_id=i, data=[i]))
        here.send(can.Message(is_remote_frame=True, arbitration_id=3))
        here.send(can.Message(is_error_frame=True))
        batch = reader.read(1.0)
        assert (len(batch.frames), batch.remote, batch.errors) == (10, 1, 1)


def passes(message: can.Message, filters: list[dict[str, int]]) -> bool:
    return any(
        (message.arbitration_id ^ f["can_id"]) & f["can_mask"] == 0 and f.get("extended") == message.is_extended_id
        for f in filters
    )


@pytest.mark.slow
def test_filters_let_through_what_is_decoded_and_little_else() -> None:
    settings = Config()
    messages = bind(settings, load_database([]))
    filters = input_filters(messages)
    rng = np.random.default_rng(1)
    idents = rng.integers(0, 1 << 29, 2000).tolist()
    idents += [6 << 26 | m.key << 8 | source for m in messages for source in (0, 0x31, 0xFE)]
    idents += [0x1CECFF00, 0x1CEBFF00, 0x1CECF900, 0x1CEBF900]
    for ident in idents:
        message = can.Message(arbitration_id=ident, data=bytes(8), is_extended_id=True)
        decoder = Decoder(messages, Bus())
        decoder.decode(Frames.from_messages([message]))
        counted = decoder.used or any(decoder.rejected.values()) or ident & 0x03FF0000 in (0xEC0000, 0xEB0000)
        assert passes(message, filters) == bool(counted)


def test_what_is_wanted_of_the_first_bytes_of_a_broadcast_comes_in_packets_too(tmp_path: Path) -> None:
    (tmp_path / "long.dbc").write_text(
        'BO_ 2566841342 LONG: 39 X\n SG_ Speed : 0|16@1+ (0.01,0) [0|300] "km/h" X\n'
        'BA_DEF_ BO_ "VFrameFormat" ENUM "StandardCAN","ExtendedCAN","reserved","J1939PG";\n'
        'BA_DEF_DEF_ "VFrameFormat" "J1939PG";\nBA_ "VFrameFormat" BO_ 2566841342 3;\n'
    )
    bound = {"bus": {"dbc": [str(tmp_path / "long.dbc")]}}
    settings = config.from_dict(bound | {"signals": {"speed": "LONG.Speed"}})
    filters = input_filters(bind(settings, load_database(settings.bus.dbc)))
    for ident in (0x18FEE300, 0x1CECFF00, 0x1CEBFF00):
        assert passes(can.Message(arbitration_id=ident, is_extended_id=True), filters)


def test_a_car_without_j1939_is_filtered_by_whole_ids(tmp_path: Path) -> None:
    (tmp_path / "car.dbc").write_text(
        'BO_ 291 MOTION: 8 X\n SG_ Speed : 0|16@1+ (0.01,0) [0|300] "km/h" X\n'
        'BO_ 2147484000 MOTOR: 8 X\n SG_ Power : 0|16@1+ (0.1,0) [0|500] "kW" X\n'
    )
    bound = {"bus": {"dbc": [str(tmp_path / "car.dbc")]}}
    settings = config.from_dict(bound | {"signals": {"speed": "MOTION.Speed", "engine_power": "MOTOR.Power"}})
    filters = input_filters(bind(settings, load_database(settings.bus.dbc)))
    assert passes(can.Message(arbitration_id=291, is_extended_id=False), filters)
    assert passes(can.Message(arbitration_id=2147484000 & 0x1FFFFFFF, is_extended_id=True), filters)
    assert not passes(can.Message(arbitration_id=291, is_extended_id=True), filters)
    assert not passes(can.Message(arbitration_id=290, is_extended_id=False), filters)


def test_a_node_hears_claims_requests_and_rivals() -> None:
    filters = node_filters(0xFB)
    rivals = [6 << 26 | pgn << 8 | 0x31 for pgn in output_groups()]
    for ident in (0x18EEFF21, 0x18EAFF21, 0x18EAFB21, 0x0CF004FB, *rivals):
        assert passes(can.Message(arbitration_id=ident, is_extended_id=True), filters)
    assert not passes(can.Message(arbitration_id=0x18FEF100, is_extended_id=True), filters)

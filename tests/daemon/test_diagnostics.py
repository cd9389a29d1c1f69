"""Our own faults on the bus: DM1 and DM2 in the bytes of J1939-73, sent whole by the transport protocol."""

import os
from pathlib import Path

import can
import numpy as np
import pytest
from daemon_bench import EPOCH, Bench, frame
from hypothesis import given
from hypothesis import strategies as st

from estimator import config
from estimator.can_io.binding import bind, load_database
from estimator.can_io.contradiction import Contradiction
from estimator.can_io.frames import Frames
from estimator.can_io.j1939 import Transport
from estimator.can_io.j1939_name import Name
from estimator.can_io.j1939_node import ADDRESS_CLAIMED
from estimator.can_io.publisher import output_database
from estimator.can_io.transport_sender import MAX_CONNECTIONS, T3, TransportSender
from estimator.can_io.trouble_codes import (
    CONFIRM_S,
    DM1,
    DM2,
    DM3,
    DM11,
    MAX_CODES,
    MAX_COUNT,
    Fmi,
    TroubleCode,
    TroubleMemory,
    codes_of,
)
from estimator.config import Config
from estimator.daemon.service import faults
from estimator.daemon.service.faults import ESTIMATE, FIRST_ROLE, FRAMES_LOST, STATE_NOT_SAVED, Faults
from estimator.daemon.service.worker import Knowledge
from estimator.errors import InputError
from estimator.estimates import Coverage, Estimate, Status
from estimator.input_files import MIB
from estimator.signals import Role

SPEED = TroubleCode(84, Fmi.NETWORK_DATA)
OWN = TroubleCode(ESTIMATE, Fmi.ERRATIC)
CODES = st.builds(TroubleCode, st.integers(0, (1 << 19) - 1), st.integers(0, 31))
TRANSMIT = config.from_dict({"transmit": {"enabled": True}})
ADDRESS, TOOL = 0xFB, 0xF9


def memory_of(*codes: TroubleCode) -> TroubleMemory:
    memory = TroubleMemory()
    memory.observe(codes, 0.0)
    memory.observe(codes, CONFIRM_S)
    return memory


# Layout and memory


def test_messages_in_the_bytes_of_j1939_73() -> None:
    assert TroubleMemory().message(DM1) == bytes.fromhex("00FF 00000000 FFFF")
    # SPN 84 = 0x00054, FMI 19 = 0x13, one occurrence
    assert memory_of(SPEED).message(DM1) == bytes.fromhex("00FF 54001301 FFFF")
    # SPN 516096 = 0x7E000: low 16 bits E000, high 3 bits 7 above FMI 2
    assert memory_of(OWN).message(DM1) == bytes.fromhex("00FF 00E0E201 FFFF")
    assert memory_of(SPEED, OWN).message(DM1) == bytes.fromhex("00FF 54001301 00E0E201")
    assert memory_of(SPEED).message(DM2) == bytes.fromhex("00FF 00000000 FFFF")


def test_the_shipped_database_reads_a_single_code() -> None:
    sent = output_database().get_message_by_name("DM1").decode(memory_of(OWN).message(DM1))
    assert int(sent["DM1SPNHigh"]) << 16 | int(sent["DM1SPNLow"]) == ESTIMATE
    assert (sent["DM1FMI"], sent["DM1OccurrenceCount"], sent["DM1Lamps"]) == (2, 1, 0)


@given(CODES, st.integers(0, 127))
def test_a_code_survives_its_bytes(code: TroubleCode, count: int) -> None:
    assert TroubleCode.decoded(code.encoded(count)) == (code, count)


@given(st.lists(CODES.filter(lambda code: code.spn not in (0, (1 << 19) - 1)), unique=True, max_size=40))
def test_all_active_codes_are_in_the_message_up_to_the_limit(codes: list[TroubleCode]) -> None:
    message = memory_of(*codes).message(DM1)
    assert len(message) >= 8
    assert codes_of(message) == [(code, 1) for code in sorted(codes)[:MAX_CODES]]


def test_a_fault_is_active_once_it_has_lasted_and_is_remembered_and_counted() -> None:
    memory = TroubleMemory()
    assert not memory.observe({SPEED}, 0.0)
    assert not memory.observe(set(), 9.0)
    assert not memory.observe({SPEED}, 10.0)  # a break: it begins anew
    assert not memory.observe({SPEED}, 19.9)
    assert memory.observe({SPEED}, 20.0)
    assert (memory.active, memory.previous) == ({SPEED: 1}, {})
    assert memory.observe(set(), 21.0)
    assert (memory.active, memory.previous) == ({}, {SPEED: 1})
    assert codes_of(memory.message(DM2)) == [(SPEED, 1)]
    memory.observe({SPEED}, 30.0)
    memory.observe({SPEED}, 40.0)
    assert (memory.active, memory.previous) == ({SPEED: 2}, {})
    memory.remember([(OWN, MAX_COUNT)])
    for k in range(3):
        memory.observe({OWN}, 50.0 + 20 * k)
        memory.observe({OWN}, 60.0 + 20 * k)
        memory.observe(set(), 65.0 + 20 * k)
    assert memory.previous[OWN] == MAX_COUNT
    memory.clear_previous()
    assert codes_of(memory.message(DM2)) == []


@pytest.mark.slow
@given(st.lists(st.tuples(st.floats(0, 30), st.sets(CODES, max_size=30)), max_size=30))
def test_whatever_comes_and_goes_is_bounded(changes: list[tuple[float, set[TroubleCode]]]) -> None:
    memory, t = TroubleMemory(), 0.0
    for wait, present in changes:
        t += wait
        memory.observe(present, t)
        assert set(memory.active) <= present
        assert not set(memory.active) & set(memory.previous)
        assert max(len(memory.active), len(memory.previous)) <= MAX_CODES


# Transport


def played(sender: TransportSender, until: float, begin: float = 0.0, address: int = ADDRESS) -> list[can.Message]:
    frames = []
    for t in np.arange(begin, until, 0.01):
        for message in sender.poll(float(t), address):
            message.timestamp = float(t)
            frames.append(message)
    return frames


def control(kind: int, *rest: int, pgn: int = DM2) -> bytes:
    return bytes([kind, *rest]).ljust(5, b"\xff") + pgn.to_bytes(3, "little")


@given(st.binary(min_size=9, max_size=150))
def test_a_broadcast_is_put_together_again_by_a_receiver(payload: bytes) -> None:
    sender = TransportSender()
    assert sender.send(0xFF, DM1, payload)
    assert not sender.send(0xFF, DM1, payload)
    sent = played(sender, 2.0)
    assert sent[0].arbitration_id == 0x1CECFFFB
    assert {message.arbitration_id for message in sent[1:]} == {0x1CEBFFFB}
    gaps = np.diff([message.timestamp for message in sent])
    assert gaps.min() >= 0.0499
    assert gaps.max() <= 0.2
    (whole,) = Transport().feed(Frames.from_messages(sent))
    assert (whole.pgn, whole.source, whole.payload) == (DM1, ADDRESS, payload)
    assert sender.send(0xFF, DM1, payload)


def test_a_connection_in_the_bytes_of_j1939_21() -> None:
    sender, payload = TransportSender(), bytes(range(18))
    assert sender.send(TOOL, DM2, payload)
    (request,) = played(sender, 0.5)
    assert (request.arbitration_id, bytes(request.data)) == (0x1CECF9FB, bytes.fromhex("10 1200 03 FF CBFE00"))
    sender.hear(TOOL, control(0x11, 2, 1), 0.5)
    first = played(sender, 1.0, 0.5)
    assert [m.arbitration_id for m in first] == [0x1CEBF9FB] * 2
    assert [bytes(m.data) for m in first] == [bytes([1, *range(7)]), bytes([2, *range(7, 14)])]
    sender.hear(TOOL, control(0x11, 0, 0xFF), 1.0)  # hold
    assert played(sender, 2.0, 1.0) == []
    sender.hear(TOOL, control(0x11, 2, 2), 2.0)  # the second once more, and the last
    again = played(sender, 2.5, 2.0)
    assert [m.data[0] for m in again] == [2, 3]
    assert bytes(again[1].data) == bytes([3, 14, 15, 16, 17, 0xFF, 0xFF, 0xFF])
    sender.hear(TOOL, control(0x13, 18, 0, 3), 2.5)
    assert played(sender, 10.0, 2.5) == []
    assert sender.send(TOOL, DM2, payload)


def test_a_connection_that_nobody_answers_is_aborted() -> None:
    sender = TransportSender()
    sender.send(TOOL, DM2, bytes(18))
    sent = played(sender, T3 + 1.0)
    assert [m.data[0] for m in sent] == [0x10, 0xFF]
    assert bytes(sent[1].data) == bytes.fromhex("FF 03 FFFFFF CBFE00")
    assert sender.send(TOOL, DM2, bytes(18))


def test_answers_of_others_and_of_other_groups_are_passed_over() -> None:
    sender = TransportSender()
    sender.send(TOOL, DM2, bytes(18))
    played(sender, 0.1)
    sender.hear(0x21, control(0x11, 3, 1), 0.1)
    sender.hear(TOOL, control(0x11, 3, 1, pgn=DM1), 0.1)
    sender.hear(TOOL, control(0x11, 3, 9), 0.1)
    sender.hear(TOOL, control(0x11, 3, 0), 0.1)
    sender.hear(TOOL, b"\x11\x03\x01", 0.1)
    assert played(sender, 1.0, 0.1) == []


def test_what_another_address_began_is_dropped() -> None:
    sender = TransportSender()
    sender.send(0xFF, DM1, bytes(18))
    played(sender, 0.07)
    assert sender.poll(0.1, 0x80) == []
    assert played(sender, 2.0, 0.2, 0x80) == []


def test_connections_are_limited_and_a_short_message_is_refused() -> None:
    sender = TransportSender()
    assert [sender.send(to, DM2, bytes(18)) for to in range(MAX_CONNECTIONS + 1)] == [True] * MAX_CONNECTIONS + [False]
    assert sender.send(0xFF, DM1, bytes(18))
    with pytest.raises(ValueError, match="8 bytes"):
        sender.send(0x99, DM2, bytes(8))


@pytest.mark.slow
@given(st.lists(st.tuples(st.floats(0, 2), st.sampled_from([TOOL, 0x21]), st.binary(max_size=8)), max_size=30))
def test_no_answer_breaks_a_connection_or_floods_the_bus(answers: list[tuple[float, int, bytes]]) -> None:
    sender, t, sent = TransportSender(), 0.0, 0
    sender.send(TOOL, DM2, bytes(82))
    for wait, source, data in answers:
        t += wait
        sender.hear(source, data, t)
        sender.hear(source, data[:2].ljust(5, b"\x01") + DM2.to_bytes(3, "little"), t)
        sent += len(sender.poll(t, ADDRESS))
    assert sent <= len(answers)


# Which faults there are


def finder() -> Faults:
    return Faults(bind(Config(), load_database([])), 3600.0)


def known(**arguments: object) -> Knowledge:
    return Knowledge(t=1000.0, **arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("knowledge", "code"),
    [
        (known(contested={"CCVS1.WheelBasedVehicleSpeed": Contradiction.SENDERS_DISAGREE.value}), (84, 19)),
        (known(contested={"EEC1.ActualEngPercentTorque": Contradiction.ALTERNATING.value}), (513, 2)),
        (known(contested={"EEC1.EngSpeed": Contradiction.FASTER.value}), (190, 9)),
        (known(contested={"EC1.EngReferenceTorque": Contradiction.CHANGED.value}), (544, 19)),
        (known(missing=("EC1.EngReferenceTorque",)), (544, 9)),
        (known(missing=("engine_power",)), (FIRST_ROLE + 2, 9)),
        (known(newest={"speed": 960.0, "engine_speed": 990.0}), (84, 9)),
    ],
)
def test_a_faulty_input_has_the_number_of_its_signal(knowledge: Knowledge, code: tuple[int, int]) -> None:
    assert finder().present(knowledge, 0.0, 0, "") == {TroubleCode(*code)}


def test_inputs_that_come_or_are_not_needed_are_no_fault() -> None:
    knowledge = known(newest={"speed": 980.0, "altitude": 0.0, "reference_torque": 0.0})
    assert finder().present(knowledge, 0.0, 0, "") == set()
    off = known(newest={"speed": 900.0, "engine_speed": 900.0, "ambient_temperature": 999.0})
    assert finder().present(off, 0.0, 0, "") == set()
    assert list(Role).index(Role.ENGINE_POWER) == 2  # the numbers of roles are published: they do not change


def concluded(status: Status, t: float) -> Estimate:
    return Estimate(
        t=t, status=status, reason="", coverage=Coverage(1, 2), admitted=0, mass=None, A=None, C=None, convergence=None
    )


def test_the_estimate_and_the_device_have_numbers_of_their_own() -> None:
    found = finder()
    assert found.present(known(estimate=concluded(Status.INVALID, 990.0)), 0.0, 0, "") == {OWN}
    stale = known(estimate=concluded(Status.ESTIMATED, 1000.0 - 3601.0))
    assert found.present(stale, 0.0, 0, "") == {TroubleCode(ESTIMATE, Fmi.UPDATE_RATE)}
    assert found.present(known(), 1.0, 0, "read-only") == {TroubleCode(STATE_NOT_SAVED, Fmi.BAD_DEVICE)}
    lost = TroubleCode(FRAMES_LOST, Fmi.NETWORK_DATA)
    assert [found.present(known(), t, n, "") for t, n in ((2.0, 5), (60.0, 5), (63.0, 5), (64.0, 6))] == [
        {lost},
        {lost},
        set(),
        {lost},
    ]


# On the bus


def groups(messages: list[can.Message]) -> list[int]:
    return [message.arbitration_id >> 8 & 0x3FFFF for message in messages]


def sent_since(bench: Bench, count: int) -> list[can.Message]:
    return bench.bus.sent[count:]


def request(pgn: int, destination: int = ADDRESS) -> can.Message:
    return frame(0x18EA0000 | destination << 8 | TOOL, pgn.to_bytes(3, "little"))


@pytest.fixture
def sending(tmp_path: Path) -> Bench:
    """A daemon that has an address, on a bus that has one signal of all that are needed."""
    bench = Bench(tmp_path, TRANSMIT, transmit=True)
    bench.turn()
    bench.traffic(2.0)
    assert bench.transmitter is not None
    assert bench.transmitter.address == ADDRESS
    return bench


def speed(km_h: int) -> can.Message:
    return frame(0x18FEF100, bytes([0xFF, 0, km_h]) + b"\xff" * 5)


@pytest.mark.slow
def test_dm1_goes_out_every_second_and_tells_of_inputs_that_do_not_come(sending: Bench) -> None:
    first = [m for m in sending.bus.sent if groups([m]) == [DM1]]
    assert {bytes(m.data) for m in first} == {bytes.fromhex("00FF 00000000 FFFF")}
    sending.traffic(20.0, speed(80))
    before = len(sending.bus.sent)
    sending.traffic(10.0, speed(80))
    heard = Frames.from_messages(stamped(sent_since(sending, before)))
    received = Transport().feed(heard)
    assert 9 <= len(received) <= 11
    assert all(message.pgn == DM1 for message in received)
    codes = {str(code) for code, _ in codes_of(received[-1].payload)}
    assert codes == {"SPN 513 FMI 9", "SPN 190 FMI 9", "SPN 514 FMI 9", "SPN 544 FMI 9"}
    assert set(sending.daemon.status(sending.now).transmit.trouble_codes) == codes


def stamped(messages: list[can.Message]) -> list[can.Message]:
    """With times, which the bench does not give, of a bus that carries one every 50 ms."""
    return [
        can.Message(arbitration_id=m.arbitration_id, data=m.data, is_extended_id=True, timestamp=EPOCH + 0.05 * i)
        for i, m in enumerate(messages)
    ]


def test_dm2_is_answered_by_a_frame_or_a_connection_and_dm3_clears_it(sending: Bench) -> None:
    assert sending.transmitter is not None
    assert sending.transmitter.diagnostics is not None
    before = len(sending.bus.sent)
    sending.traffic(0.1, request(DM2))
    answer = next(m for m in sent_since(sending, before) if groups([m]) == [DM2])
    assert (answer.arbitration_id, bytes(answer.data)) == (0x18FECBFB, bytes.fromhex("00FF 00000000 FFFF"))
    sending.transmitter.diagnostics.memory.remember([(SPEED, 1), (OWN, 2), (TroubleCode(190, 9), 3)])
    before = len(sending.bus.sent)
    sending.traffic(0.2, request(DM2))
    announced = next(m for m in sent_since(sending, before) if m.arbitration_id == 0x1CECF9FB)
    assert bytes(announced.data) == bytes.fromhex("10 0E00 02 FF CBFE00")
    sending.traffic(0.1, frame(0x1CECFBF9, control(0x11, 2, 1)))
    sending.traffic(0.5)
    packets = [m for m in sent_since(sending, before) if m.arbitration_id == 0x1CEBF9FB]
    content = b"".join(bytes(m.data[1:]) for m in packets)
    assert codes_of(content[:14]) == [(SPEED, 1), (OWN, 2), (TroubleCode(190, 9), 3)]
    before = len(sending.bus.sent)
    sending.traffic(0.1, request(DM3))
    acknowledged = next(m for m in sent_since(sending, before) if groups([m]) == [0xE8FF])
    assert bytes(acknowledged.data) == bytes([0, 0xFF, 0xFF, 0xFF, TOOL, 0xCC, 0xFE, 0x00])
    assert sending.transmitter.diagnostics.memory.previous == {}


def acknowledgements(messages: list[can.Message]) -> list[bytes]:
    return [bytes(m.data) for m in messages if groups([m]) == [0xE8FF]]


@pytest.mark.slow
@pytest.mark.parametrize("to_us", [True, False], ids=["to us", "to all"])
def test_dm11_clears_the_active_codes_and_only_those(
    sending: Bench, tmp_path: Path, caplog: pytest.LogCaptureFixture, to_us: bool
) -> None:
    assert sending.transmitter is not None
    assert sending.transmitter.diagnostics is not None
    memory = sending.transmitter.diagnostics.memory
    sending.traffic(20.0, speed(80))
    lasting = dict(memory.active)
    assert len(lasting) == 4
    memory.remember([(SPEED, 3)])
    before = len(sending.bus.sent)
    with caplog.at_level("INFO"):
        sending.traffic(0.1, request(DM11, ADDRESS if to_us else 0xFF), speed(80))
    assert (memory.active, memory.previous) == ({}, {SPEED: 3})
    assert "active trouble codes cleared" in caplog.text
    expected = [bytes([0, 0xFF, 0xFF, 0xFF, TOOL, 0xD3, 0xFE, 0x00])] if to_us else []
    assert acknowledgements(sent_since(sending, before)) == expected
    sending.traffic(1.0, speed(80))
    told = next(m for m in sent_since(sending, before) if groups([m]) == [DM1])
    assert codes_of(bytes(told.data)) == []
    assert faults.load(tmp_path / "codes.json") == [(SPEED, 3)]
    sending.traffic(CONFIRM_S + 1, speed(80))
    assert memory.active == lasting  # the faults are still there


def test_clearing_nothing_is_acknowledged_and_not_logged(sending: Bench, caplog: pytest.LogCaptureFixture) -> None:
    before = len(sending.bus.sent)
    with caplog.at_level("INFO"):
        sending.traffic(0.1, request(DM11))
        sending.traffic(0.1, request(DM3))
    assert [data[0] for data in acknowledgements(sent_since(sending, before))] == [0, 0]
    assert "cleared" not in caplog.text


@pytest.mark.slow
def test_codes_that_dm3_cleared_do_not_come_back_with_the_next_start(sending: Bench, tmp_path: Path) -> None:
    assert sending.transmitter is not None
    assert sending.transmitter.diagnostics is not None
    sending.transmitter.diagnostics.memory.remember([(OWN, 2)])
    sending.traffic(20.0, speed(80))
    assert OWN in dict(faults.load(tmp_path / "codes.json"))
    sending.traffic(0.1, request(DM3), speed(80))
    sending.traffic(1.0, speed(80))
    assert OWN not in dict(faults.load(tmp_path / "codes.json"))


@pytest.mark.slow
def test_a_flood_of_requests_for_many_codes_is_not_answered_with_a_flood(sending: Bench) -> None:
    assert sending.transmitter is not None
    assert sending.transmitter.diagnostics is not None
    sending.transmitter.diagnostics.memory.remember([(TroubleCode(1000 + k, 9), 1) for k in range(MAX_CODES)])
    before, began = len(sending.bus.sent), sending.now
    for _ in range(300):
        grant = [frame(0x1CECFB00 | tool, control(0x11, 255, 1)) for tool in range(20)]
        asked = [frame(0x18EAFB00 | tool, DM2.to_bytes(3, "little")) for tool in range(20)]
        sending.put(*asked, *grant, request(DM2, 0xFF))
        sending.turn(0.1)
    assert sending.transmitter.node.counts["request not answered"] > 1000
    assert len(sending.bus.sent) - before < 30 + 30 * (sending.now - began)


def test_switched_off_there_is_neither_broadcast_nor_answer() -> None:
    bench = Bench(config=config.from_dict({"transmit": {"enabled": True, "diagnostics": False}}), transmit=True)
    bench.turn()
    bench.traffic(30.0, speed(80))
    bench.traffic(0.1, request(DM2))
    assert not {DM1, DM2, 0xECFF} & set(groups(bench.bus.sent))
    assert bytes(next(m for m in bench.bus.sent if groups([m]) == [0xE8FF]).data[:1]) == b"\x01"


@pytest.mark.slow
def test_an_ignition_that_is_off_leaves_the_codes_as_they_are(sending: Bench) -> None:
    sending.traffic(15.0, speed(80))
    assert sending.transmitter is not None
    assert sending.transmitter.diagnostics is not None
    active = dict(sending.transmitter.diagnostics.memory.active)
    sending.turn(6.0)
    before = sum(len(bus.sent) for bus in sending.buses)
    sending.turn(100.0)
    assert sum(len(bus.sent) for bus in sending.buses) == before
    assert sending.transmitter.diagnostics.memory.active == active != {}


def test_codes_outlast_the_power(sending: Bench, tmp_path: Path) -> None:
    sending.traffic(15.0, speed(80))
    kept = dict(faults.load(tmp_path / "codes.json"))
    assert TroubleCode(513, Fmi.UPDATE_RATE) in kept
    memory = TroubleMemory()
    memory.remember(kept.items())
    assert memory.previous == kept
    assert faults.load(tmp_path / "none.json") == []


@pytest.mark.parametrize("content", [b"", b"{}", b"[[1]]", b'[{"spn":-1,"fmi":0,"count":1}]', b"\xff\xfe", b"[" * 9999])
def test_a_file_that_holds_no_codes_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "codes.json").write_bytes(content)
    with pytest.raises(InputError, match="holds no trouble codes"):
        faults.load(tmp_path / "codes.json")


@pytest.mark.parametrize("kind", ["link", "device", "pipe", "of everybody", "endless"])
def test_a_file_of_codes_that_somebody_else_planted_is_refused(tmp_path: Path, kind: str) -> None:
    path, elsewhere = tmp_path / "codes.json", tmp_path / "elsewhere"
    elsewhere.write_bytes(b"[]")
    if kind == "pipe":
        os.mkfifo(path)
    elif kind in ("link", "device"):
        path.symlink_to(elsewhere if kind == "link" else "/dev/zero")
    else:
        path.write_bytes(b"[]" + b" " * (MIB if kind == "endless" else 0))
        path.chmod(0o666 if kind == "of everybody" else 0o600)
    with pytest.raises(InputError, match=r"codes\.json"):
        faults.load(path)


# Commanded Address


def commands(name: bytes, address: int, source: int = 0x21) -> list[can.Message]:
    payload = (name + bytes([address])).ljust(14, b"\xff")
    return [
        frame(0x1CECFF00 | source, bytes([0x20, 9, 0, 2, 0xFF, 0xD8, 0xFE, 0x00])),
        frame(0x1CEBFF00 | source, b"\x01" + payload[:7]),
        frame(0x1CEBFF00 | source, b"\x02" + payload[7:]),
    ]


def own_name(bench: Bench) -> bytes:
    return bytes(next(m for m in bench.bus.sent if groups([m]) == [ADDRESS_CLAIMED | 0xFF]).data)


def commandable() -> Bench:
    bench = Bench(config=config.from_dict({"transmit": {"enabled": True, "commanded_address": True}}), transmit=True)
    bench.turn()
    bench.traffic(2.0)
    return bench


def claims(messages: list[can.Message]) -> list[int]:
    return [m.arbitration_id & 0xFF for m in messages if groups([m]) == [ADDRESS_CLAIMED | 0xFF]]


def test_a_commanded_address_is_claimed_and_kept_after_the_bus_was_away() -> None:
    bench = commandable()
    before = len(bench.bus.sent)
    bench.put(*commands(own_name(bench), 0x40))
    bench.turn(0.1)
    assert claims(sent_since(bench, before)) == [0x40]
    bench.traffic(2.0)
    assert bench.transmitter is not None
    assert bench.transmitter.address == 0x40
    assert {m.arbitration_id & 0xFF for m in sent_since(bench, before)} == {0x40}
    bench.bus.failures.append(OSError(19, "No such device"))
    bench.turn(2.0)
    bench.traffic(2.0)
    assert bench.transmitter.address == 0x40


@pytest.mark.parametrize("address", [0x00, 0xFE, 0xFF])
def test_an_address_that_is_taken_or_none_is_refused_with_our_claim(address: int) -> None:
    bench = commandable()
    lower = bytes(Name(identity=1, manufacturer=0, function=0, industry_group=0, arbitrary_address_capable=0))
    bench.put(frame(0x18EEFF00, lower))
    bench.turn(0.1)
    before = len(bench.bus.sent)
    bench.put(*commands(own_name(bench), address))
    bench.turn(0.1)
    assert claims(sent_since(bench, before)) == [ADDRESS]
    assert bench.transmitter is not None
    assert bench.transmitter.address == ADDRESS
    assert bench.transmitter.events["commanded address refused"] == 1


def test_by_default_and_for_another_name_the_address_stays(sending: Bench) -> None:
    bench = commandable()
    before = len(bench.bus.sent)
    bench.put(*commands(bytes(8), 0x40))
    bench.turn(0.1)
    assert claims(sent_since(bench, before)) == []
    before = len(sending.bus.sent)
    sending.put(*commands(own_name(sending), 0x40))
    sending.turn(0.1)
    assert claims(sent_since(sending, before)) == [ADDRESS]
    sending.traffic(1.0)
    assert sending.transmitter is not None
    assert sending.transmitter.address == ADDRESS

"""The loop: what it sends and keeps back, what it says of itself, and that nothing on a bus breaks it."""

import socket
from collections.abc import Mapping
from pathlib import Path

import can
import numpy as np
import pytest
from daemon_bench import EPOCH, Bench, frame
from hypothesis import given, settings
from hypothesis import strategies as st
from made_estimates import made_estimate
from msgspec.structs import replace

from estimator import config
from estimator.answers.answer import decode, encode
from estimator.answers.status import State, StatusAnswer
from estimator.can_io.counter_crc import verify
from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.j1939_name import Name
from estimator.can_io.publisher import output_database, output_groups
from estimator.config import Config
from estimator.daemon.reception.reader import Batch
from estimator.daemon.service import metrics, status_file
from estimator.daemon.service.loop import Daemon
from estimator.daemon.service.sd_notify import Notifier
from estimator.daemon.service.worker import Knowledge, Worker
from estimator.errors import InputError, RoadloadError
from estimator.settings import Reception
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.pipeline import Pipeline
from estimator.streaming.replay import estimate_logs

CLAIM, REQUEST = 0x18EEFF00, 0x18EAFF00
TRANSMIT = config.from_dict({"transmit": {"enabled": True}, "publish": {"cvw": True}})


def groups(messages: list[can.Message]) -> list[int]:
    return [message.arbitration_id >> 8 & 0x3FFFF for message in messages]


def broadcast(bench: Bench) -> list[can.Message]:
    return [message for message in bench.bus.sent if message.arbitration_id >> 8 & 0x3FFFF in output_groups()]


@pytest.fixture
def sending() -> Bench:
    """A daemon that has an address and broadcasts."""
    bench = Bench(config=TRANSMIT, transmit=True)
    bench.turn()
    bench.traffic(2.0)
    assert bench.transmitter is not None
    assert bench.transmitter.address == 0xFB
    return bench


def test_a_listener_sends_nothing() -> None:
    bench = Bench()
    bench.turn()
    bench.traffic(30.0, frame(0x18FEF100), frame(REQUEST | 0xFE, bytes([0, 0xEE, 0])))
    assert bench.bus.sent == []


def test_nothing_is_broadcast_before_the_address_is_claimed(sending: Bench) -> None:
    claimed = groups(sending.bus.sent).index(0xEEFF)
    first = groups(sending.bus.sent).index(0xFF60)
    assert claimed < first
    waited = sending.bus.sent[first].timestamp - (100.0 + EPOCH)
    assert waited >= 0.25
    assert all(verify(m) for m in broadcast(sending) if m.arbitration_id >> 8 & 0xFFFF != 0xFE70)


def test_the_address_is_claimed_only_once_the_claim_has_been_on_the_bus() -> None:
    bench = Bench(config=TRANSMIT, transmit=True)
    bench.turn()
    bench.bus.busy = True
    bench.traffic(0.9)
    assert groups(bench.bus.sent) == [0xEAFF, 0xEEFF]
    bench.bus.busy = False
    bench.traffic(0.2)
    assert broadcast(bench) == []
    bench.traffic(0.3)
    assert groups(broadcast(bench))[0] == 0xFF60


def test_a_claim_that_does_not_reach_the_bus_is_sent_again_and_counted() -> None:
    bench = Bench(config=TRANSMIT, transmit=True)
    bench.turn()
    bench.bus.busy = True
    bench.traffic(30.0)
    assert set(groups(bench.bus.sent)) == {0xEAFF, 0xEEFF}
    assert 25 <= groups(bench.bus.sent).count(0xEEFF) <= 30
    transmit = bench.daemon.status(bench.now).transmit
    assert transmit.address is None
    assert transmit.events["claim not confirmed"] >= 24


def test_before_the_first_estimate_all_values_are_not_available(sending: Bench) -> None:
    for message in broadcast(sending):
        if message.arbitration_id >> 8 & 0xFFFF != 0xFF60:
            assert message.data[:6] == b"\xff" * 6


def test_who_loses_the_address_goes_on_under_another(sending: Bench) -> None:
    lower = bytes(Name(identity=0, manufacturer=0, function=0, industry_group=0, arbitrary_address_capable=0))
    sending.put(frame(CLAIM | 0xFB, lower))
    before = len(sending.bus.sent)
    sending.turn(0.2, step=0.05)
    assert not [m for m in sending.bus.sent[before:] if m.arbitration_id >> 8 & 0x3FFFF in output_groups()]
    sending.traffic(3.0)
    assert sending.transmitter is not None
    assert sending.transmitter.address not in (None, 0xFB)
    assert broadcast(sending)[-1].arbitration_id & 0xFF == sending.transmitter.address


@pytest.mark.slow
def test_an_id_that_another_node_sends_is_withheld_and_said(sending: Bench) -> None:
    before = groups(sending.bus.sent).count(0xFF60)
    sending.put(frame(0x18FF60FB))
    sending.traffic(5.0)
    assert groups(sending.bus.sent).count(0xFF60) == before
    assert sending.transmitter is not None
    assert sending.transmitter.withheld == {"another node sends from our address": 5}
    assert sending.daemon.status(sending.now).transmit.colliding_groups == ("FF60",)
    sending.traffic(60.0)
    assert groups(sending.bus.sent).count(0xFF60) > before


def test_reasons_for_withholding_are_few_whatever_others_send(sending: Bench) -> None:
    for source in range(253, -1, -12):
        for address in (source, 0xFB):
            sending.put(*(frame(0x18000000 | pgn << 8 | address) for pgn in sorted(output_groups())))
        sending.traffic(1.0)
    transmit = sending.daemon.status(sending.now).transmit
    assert set(transmit.withheld) == {"another node sends the CVW", "another node sends from our address"}
    assert len(transmit.colliding_groups) == len(output_groups(cvw=False))


def test_a_copy_of_our_own_claim_changes_nothing(sending: Bench) -> None:
    claim = next(m for m in sending.bus.sent if m.arbitration_id == CLAIM | 0xFB)
    before = len(broadcast(sending))
    for _ in range(10):
        sending.put(frame(claim.arbitration_id, bytes(claim.data)))
        sending.traffic(1.0)
    assert sending.transmitter is not None
    assert sending.transmitter.address == 0xFB
    assert len(broadcast(sending)) - before >= 10
    assert sending.transmitter.events["own claim repeated"] == 10


def test_our_name_at_another_address_silences_us_for_seconds_and_not_for_good(sending: Bench) -> None:
    claim = next(m for m in sending.bus.sent if m.arbitration_id == CLAIM | 0xFB)
    sending.put(frame(CLAIM | 0x80, bytes(claim.data)))
    sending.traffic(1.0)
    assert sending.transmitter is not None
    assert sending.transmitter.address is None
    assert "has our NAME" in sending.daemon.status(sending.now).transmit.fault
    sending.traffic(12.0)
    assert sending.transmitter.address == 0xFB
    assert sending.daemon.status(sending.now).transmit.fault == ""
    assert sending.transmitter.events["NAME used by another"] == 1


@pytest.mark.slow
def test_forged_claims_of_all_addresses_silence_us_only_as_long_as_they_last(sending: Bench) -> None:
    lower = {
        address: bytes(Name(identity=address, manufacturer=0, function=0, industry_group=0))
        for address in (0xFB, *range(128, 248))
    }
    for _ in range(120):
        sending.put(*(frame(CLAIM | address, name) for address, name in lower.items()))
        sending.traffic(1.0)
    assert sending.transmitter is not None
    assert sending.transmitter.address is None
    assert sending.transmitter.events["address lost"] <= 5 * len(lower)  # claimed anew ever more rarely
    before = len(broadcast(sending))
    sending.traffic(90.0)
    assert sending.transmitter.address is not None
    assert len(broadcast(sending)) > before


def test_a_foreign_weight_keeps_ours_back(sending: Bench) -> None:
    assert 0xFE70 in groups(sending.bus.sent)
    before = groups(sending.bus.sent).count(0xFE70)
    sending.traffic(25.0, frame(0x18FE7031))
    assert groups(sending.bus.sent).count(0xFE70) == before
    transmit = sending.daemon.status(sending.now).transmit
    assert transmit.foreign_weights == (0x31,)
    assert any("CVW" in reason for reason in transmit.withheld)


def test_a_sleeping_vehicle_is_left_asleep(sending: Bench) -> None:
    sending.turn(6.0)
    before = sum(len(bus.sent) for bus in sending.buses)
    sending.turn(200.0)
    assert sum(len(bus.sent) for bus in sending.buses) == before
    assert sending.daemon.state == State.SILENT
    sending.traffic(2.0)
    assert broadcast(sending)


def test_requests_are_answered_and_refused(sending: Bench) -> None:
    sending.put(frame(0x18EAFB21, bytes([0x61, 0xFF, 0x00])), frame(0x18EAFB21, bytes([0x65, 0xFE, 0x00])))
    before = len(sending.bus.sent)
    sending.turn(0.1)
    answers = sending.bus.sent[before:]
    assert 0xFF61 in groups(answers)
    assert 0xE8FF in groups(answers)


def test_a_request_that_wakes_the_bus_is_not_answered_with_an_estimate_of_the_day_before(sending: Bench) -> None:
    assert sending.transmitter is not None
    now, t = sending.now, sending.now + EPOCH
    sending.transmitter.turn(now, t, made_estimate(t), is_receiving=True)
    now, t = now + 8 * 3600.0, t + 8 * 3600.0
    sending.transmitter.turn(now, t, made_estimate(t - 8 * 3600.0), is_receiving=False)
    before = len(sending.bus.sent)
    requests = [frame(0x18EAFB21, bytes([group, 0xFF, 0x00])) for group in (0x60, 0x61)]
    sending.transmitter.hear(Frames.from_messages(requests), Frames.from_messages([]), now)
    status, mass = sending.bus.sent[before:]
    assert output_database().decode_message(0x18FF60FB, status.data)["EstimateStatus"] == "stale"
    assert bytes(mass.data[:6]) == b"\xff" * 6


def test_a_flood_of_requests_does_not_become_a_flood_of_answers(sending: Bench) -> None:
    before = len(sending.bus.sent)
    for _ in range(100):
        sending.put(*(frame(REQUEST | source, bytes([0x61, 0xFF, 0x00])) for source in range(30)))
        sending.turn(0.1)
    assert len(sending.bus.sent) - before < 20 * 10


def test_a_first_failure_to_send_is_tolerated_and_later_ones_are_counted(sending: Bench) -> None:
    assert sending.transmitter is not None
    sending.bus.send_failures = [can.CanOperationError("Network is down")]
    sending.traffic(1.5)
    assert sending.transmitter.failed == 0
    sending.bus.send_failures = [can.CanOperationError("Network is down")] * 2
    sending.traffic(1.5)
    assert sending.transmitter.failed == 1


def test_a_reopened_bus_is_claimed_again(sending: Bench) -> None:
    sending.bus.failures.append(OSError(19, "No such device"))
    sending.turn(2.0)
    assert groups(sending.bus.sent)[:2] == [0xEAFF, 0xEEFF]
    sending.traffic(2.0)
    assert 0xFF60 in groups(sending.bus.sent)


def test_on_two_buses_only_the_one_that_is_sent_on_has_a_say_in_the_address() -> None:
    inward, outward = Bench(), Bench(config=TRANSMIT, transmit=True)
    times = {"clock": lambda: inward.now, "wall": lambda: inward.now + EPOCH}
    assert outward.transmitter is not None
    daemon = Daemon(inward.link, outward.link, inward.worker, outward.transmitter, 5.0, **times)

    def traffic(seconds: float, *messages: can.Message) -> None:
        for _ in range(round(seconds / 0.1)):
            inward.now = outward.now = inward.now + 0.1
            if inward.link.is_open:
                inward.put(*messages)
            inward.link.step(0)
            outward.link.step(0)
            daemon.turn()

    traffic(2.0, frame(0x18FEF100))
    assert outward.transmitter.address == 0xFB
    before = groups(outward.bus.sent).count(0xFF61)
    traffic(2.0, frame(0x18EEFFFB, bytes(8)), frame(0x18EAFB21, bytes([0x61, 0xFF, 0x00])), frame(0x18FE7031))
    assert outward.transmitter.address == 0xFB
    assert not outward.transmitter.events
    assert groups(outward.bus.sent).count(0xFF61) == before
    assert outward.transmitter.foreign_weights == [0x31]


def test_on_leaving_receivers_are_told_that_nothing_is_known(tmp_path: Path) -> None:
    bench = Bench(tmp_path, TRANSMIT, transmit=True)
    bench.turn()
    bench.traffic(2.0)
    assert (tmp_path / "status.json").exists()
    bench.daemon.close()
    assert bench.buses[-1].closed
    assert not (tmp_path / "status.json").exists()


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Frames:
    rng = np.random.default_rng(3)
    truck = Truck(mass=20_000.0, A=1200.0, C=3.5)
    return frames_of(record(truck, generate_route("mixed", 20e3, rng), 480.0, rng).signals)


def play(bench: Bench, frames: Frames, ahead: float = 0.0) -> None:
    """Put a recorded drive on the bus, now, with stamps ``ahead`` [s]."""
    t = frames.t - frames.t[0]
    began = bench.now
    edges = np.searchsorted(t, np.arange(0.5, t[-1] + 0.5, 0.5))
    for first, last in zip([0, *edges[:-1].tolist()], edges.tolist(), strict=True):
        bench.now += 0.5
        stamps = t[first:last] + began + bench.ahead + ahead
        batch = frames[first:last]
        bench.bus.waiting.append(Batch(frames=Frames(stamps, batch.ident, batch.length, batch.data)))
        bench.link.step(0)
        bench.daemon.turn()
        bench.worker.turn()


LENIENT = config.from_dict(
    {
        "gate": {"coverage": 0.02, "minimum_cells": 4, "interval_s": 60.0, "relative_sd": [5.0, 5.0, 1.0]},
        "transmit": {"enabled": True},
    }
)


@pytest.mark.slow
def test_a_drive_on_the_bus_is_estimated_as_from_its_log_and_broadcast(drive: Frames, tmp_path: Path) -> None:
    from estimator.can_io.log_writer import write_log

    write_log(drive, tmp_path / "drive.blf")
    expected = estimate_logs([tmp_path / "drive.blf"], LENIENT, lambda share: None)
    assert expected.updates[-2].mass is not None
    bench = Bench(tmp_path, LENIENT, transmit=True)
    bench.turn()
    play(bench, drive)
    shown = bench.worker.knowledge.estimate
    assert shown is not None
    assert shown.mass is not None
    assert shown.mass.mean == pytest.approx(expected.updates[-2].mass.mean, rel=0.01)
    masses = [m for m in broadcast(bench) if m.arbitration_id >> 8 & 0xFFFF == 0xFF61]
    decoded = output_database().decode_message("RoadloadMass", masses[-1].data)
    assert decoded["MassMean"] == pytest.approx(shown.mass.mean, abs=2.0)
    written = status_file.read(tmp_path / "status.json")
    assert written.estimate is not None
    assert written.estimate.parameters.mass_kg.mean == pytest.approx(shown.mass.mean)
    assert written.signals["speed"].age_s is not None
    assert written.signals["speed"].age_s < 10
    assert 'roadload_mass_kg{moment="mean"}' in (tmp_path / "metrics.prom").read_text()
    bench.daemon.close()
    last = output_database().decode_message("RoadloadMass", broadcast(bench)[-1].data, decode_choices=True)
    assert str(last["MassMean"]) == "not available"


@pytest.mark.nightly
@pytest.mark.slow
def test_a_clock_set_by_an_hour_in_mid_drive_does_not_harm_the_estimate(drive: Frames) -> None:
    results = []
    for step in (0.0, 3600.0, -3600.0):
        bench = Bench(config=LENIENT)
        bench.turn()
        half = len(drive) // 2
        play(bench, drive[:half])
        play(bench, drive[half:], ahead=step)
        assert bench.daemon.status(bench.now).clock_steps == (step != 0)
        shown = bench.worker.knowledge.estimate
        assert shown is not None
        assert shown.mass is not None
        results.append(shown.mass.mean)
    assert results[1:] == pytest.approx([results[0]] * 2, rel=0.01)


def test_the_watchdog_is_fed_only_while_frames_are_drained_and_the_estimator_lives(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.turn()
    assert bench.daemon.is_healthy(bench.now)
    assert not bench.daemon.is_healthy(bench.now + 30.0)
    bench.turn(1.0)
    bench.worker.turn()
    assert bench.daemon.is_healthy(bench.now)


def test_a_hung_estimator_is_noticed() -> None:
    bench = Bench()
    bench.turn()
    bench.traffic(1.0)
    seen = []

    class Hanging:
        def feed(self, frames: Frames) -> list[object]:
            bench.now += 60.0
            bench.link.step(0)
            seen.append(bench.daemon.is_healthy(bench.now))
            return []

    bench.worker._feed = lambda frames, began: Hanging().feed(frames)  # type: ignore[method-assign]
    bench.put(frame(0x18FEF100))
    bench.link.step(0)
    bench.daemon.turn()
    bench.worker.turn()
    assert seen == [False]


@pytest.mark.slow
def test_a_vehicle_at_rest_costs_no_writes() -> None:
    class Disk:
        saves = 0

        def save(self, state: Mapping[str, object], key: str) -> None:
            self.saves += 1

    disk, now = Disk(), 0.0
    worker = Worker(Pipeline(Config()), 10**6, disk, "k", 60.0, clock=lambda: now)

    def at(km_h: int, seconds: int) -> int:
        nonlocal now
        before = disk.saves
        for _ in range(5 * seconds):
            now += 0.2
            speed = frame(0x18FEF100, bytes([0xFF, 0, km_h]) + b"\xff" * 5)
            speed.timestamp = EPOCH + now
            worker.offer(Frames.from_messages([speed]))
            worker.turn()
        return disk.saves - before

    assert at(80, 210) == 3
    assert at(0, 300) <= 1
    assert at(80, 120) in (1, 2)
    assert at(0, 200) <= 1
    before = disk.saves
    worker.close()
    assert disk.saves == before + 1


def test_an_estimator_that_died_ends_the_daemon() -> None:
    bench = Bench()
    bench.worker.failure = ValueError("broken")
    with pytest.raises(RoadloadError, match="broken"):
        bench.turn()


def test_systemd_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    manager = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    manager.bind(str(tmp_path / "notify"))
    manager.settimeout(5.0)
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
    bench = Bench()
    bench.daemon._notifier = Notifier()
    bench.absent = 100
    bench.turn(1.0)
    told = manager.recv(4096).decode().splitlines()
    assert "READY=1" in told
    assert "WATCHDOG=1" in told
    assert any(line.startswith("STATUS=waiting for interface") for line in told)
    Notifier().reloading()
    while not told[0].startswith("RELOADING"):
        told = manager.recv(4096).decode().splitlines()
    assert told[0] == "RELOADING=1"
    assert told[1].startswith("MONOTONIC_USEC=")
    manager.close()


def test_a_status_is_only_that_of_a_living_and_recent_daemon(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.turn()
    written = status_file.read(tmp_path / "status.json")
    assert status_file.obstacle_to_status(written, bench.now) == ""
    assert "ago" in status_file.obstacle_to_status(written, bench.now + 60)
    assert "machine" in status_file.obstacle_to_status(written, bench.now - 60)
    assert "ended" in status_file.obstacle_to_status(replace(written, pid=2**22 + 1), bench.now)


def test_a_status_of_another_version_is_refused_with_the_reason(tmp_path: Path) -> None:
    Bench(tmp_path).turn()
    path = tmp_path / "status.json"
    newer = path.read_text().replace('"schema":1', '"schema":2')
    path.write_text(newer)
    with pytest.raises(InputError, match=r"status\.json: is not a status of this version .*schema"):
        status_file.read(path)
    path.write_text("{broken")
    with pytest.raises(InputError, match="not a status file"):
        status_file.read(path)
    path.unlink()
    path.symlink_to("/dev/zero")
    with pytest.raises(InputError, match="is larger than 1 MiB"):
        status_file.read(path)


def test_metrics_can_be_read_by_prometheus(sending: Bench) -> None:
    sending.worker.knowledge = Knowledge(refused={'odd "name"\nwith \\': 2})
    text = metrics.exposition(sending.daemon.status(sending.now))
    for line in text.splitlines():
        assert line.startswith(("# HELP roadload_", "# TYPE roadload_", "roadload_"))
        if not line.startswith("#"):
            float(line.rsplit(" ", 1)[1])
    assert r'roadload_refused_total{reason="odd \"name\"\nwith \\"} 2' in text


KNOWN = [0x18FEF100, 0x0CF00400, 0x18FEDF00, 0x1CECFF00, 0x1CEBFF00, 0x18EEFFFB, 0x18EAFFFE, 0x18FF60FB, 0x18FE7031]
MESSAGES = st.builds(
    lambda ident, extended, data, stamp, kind: can.Message(
        arbitration_id=ident if extended else ident & 0x7FF,
        is_extended_id=extended,
        data=data,
        timestamp=stamp,
        is_fd=len(data) > 8,
        is_error_frame=kind == 1,
        is_remote_frame=kind == 2,
        check=False,
    ),
    st.sampled_from(KNOWN) | st.integers(0, 0x3FFFFFFF),
    st.booleans(),
    st.binary(max_size=8) | st.binary(min_size=8, max_size=8) | st.binary(max_size=70),
    st.floats() | st.floats(EPOCH, EPOCH + 1000),
    st.sampled_from([0, 0, 0, 0, 1, 2]),
)


@pytest.mark.slow
@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(st.tuples(st.floats(0, 50), st.lists(MESSAGES, max_size=20)), max_size=12))
def test_nothing_on_a_bus_breaks_the_loop(turns: list[tuple[float, list[can.Message]]]) -> None:
    from estimator.daemon.reception.reader import pack

    bench = Bench(config=config.replace(TRANSMIT, reception=Reception(reopen_s=0)), transmit=True)
    bench.turn()
    put = 0
    for wait, messages in turns:
        bench.now += wait
        if bench.link.is_open:  # after "bus off" it is closed for a while
            bench.bus.waiting.append(pack(messages))
            put += len(messages)
        bench.link.step(0)
        bench.daemon.turn()
        bench.worker.turn()
    bench.turn()
    counts = bench.link.counts
    assert counts.frames + counts.errors + counts.remote + counts.malformed == put
    assert bench.worker.pipeline.traffic.frames == counts.frames
    assert bench.worker.drops == counts.queue_drops == 0
    shown = bench.worker.knowledge.estimate
    assert shown is None or shown.mass is None
    text = encode(bench.daemon.status(bench.now))
    assert len(text) < 50_000
    assert metrics.exposition(decode(text, StatusAnswer))
    assert len(bench.bus.sent) <= 40 + 20 * (bench.now - 100.0)


def test_the_configuration_without_a_bus_of_its_own_is_the_default() -> None:
    assert Config().transmit.enabled is False
    assert Config().publish.cvw is False


def test_attacks_recorded_on_a_truck_are_survived(recordings: Path) -> None:
    from estimator.can_io.logs import open_log

    logs = sorted((recordings / "j1939_trucks/kenworth_t270").glob("*.log"))
    assert logs
    for path in logs:
        bench = Bench(config=TRANSMIT, transmit=True)
        bench.turn()
        for frames in open_log(path):
            play(bench, frames[:20_000])
            break
        assert bench.worker.knowledge.frames > 0
        shown = bench.worker.knowledge.estimate
        assert shown is None or shown.mass is None
        assert all(verify(m) for m in broadcast(bench) if m.arbitration_id >> 8 & 0xFFFF != 0xFE70)
        assert len(bench.bus.sent) < 20 * (bench.now - 99.0)

"""The one loop: under a `can.Notifier`, in a replay and in the daemon."""

import dataclasses
from pathlib import Path

import can
import numpy as np
import pytest
from daemon_bench import Bench
from made_estimates import made_estimate
from played_bus import PlayedBus

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import EPOCH, frames_of
from estimator.can_io.log_writer import write_log
from estimator.can_io.publisher import output_groups
from estimator.config import Config, from_dict
from estimator.daemon.reception.reader import Batch
from estimator.errors import RoadloadError
from estimator.estimates import Estimate, Slope
from estimator.estimation.road_now import RoadAhead
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.listener import InlineWorker, Listener
from estimator.streaming.replay import replay

pytestmark = pytest.mark.slow

EAGER = {"gate": {"minimum_samples": 300, "coverage": 0.0, "minimum_cells": 1, "relative_sd": [9, 9, 9]}}
TRANSMITTING = from_dict({**EAGER, "transmit": {"enabled": True}})
IRRELEVANT = can.Message(arbitration_id=0x18FEFF00, data=b"\xff" * 8, is_extended_id=True)


@pytest.fixture(scope="module")
def drive() -> Frames:
    rng = np.random.default_rng(4)
    truck = Truck(mass=27_190.0, A=1739.0, C=3.74)
    return frames_of(record(truck, generate_route("mixed", 20e3, rng), 260.0, rng).signals)


@pytest.fixture(scope="module")
def log(drive: Frames, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("drive") / "drive.blf"
    write_log(drive, path)
    return path


def as_bytes(messages: list[can.Message]) -> list[tuple[int, bytes]]:
    return [(message.arbitration_id, bytes(message.data)) for message in messages]


def test_a_notifier_turns_it_as_a_replay_does(log: Path, drive: Frames) -> None:
    expected = replay([log], from_dict(EAGER))
    bus = PlayedBus(drive.messages())
    listener = Listener.of(from_dict(EAGER), bus.send)
    with bus, can.Notifier(bus, [listener], timeout=0.01):
        assert bus.has_failed.wait(120)
    assert as_bytes(bus.sent) == as_bytes(expected.broadcast)
    assert listener.latest == expected.final


def test_a_bus_that_fails_under_a_notifier_is_not_lost(drive: Frames) -> None:
    bus = PlayedBus(drive[:5000].messages())
    worker = InlineWorker(Config())
    with (
        pytest.raises(RoadloadError, match="the bus failed 3 times: Network is down") as raised,
        bus,
        Listener(worker, lambda t, estimate, slope: None) as listener,
        can.Notifier(bus, [listener], timeout=0.01),
    ):
        assert bus.has_failed.wait(60)
    assert isinstance(raised.value.__cause__, can.CanOperationError)
    assert worker.pipeline.traffic.frames == 5000


def test_an_error_of_the_caller_comes_before_one_of_the_bus() -> None:
    def fail(listener: Listener) -> None:
        with listener:
            listener.on_error(can.CanOperationError("Network is down"))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail(Listener.of(Config(), lambda message: None))


def test_a_last_broadcast_that_fails_is_told(drive: Frames) -> None:
    calls: list[float] = []

    def broadcast(t: float, estimate: Estimate | None, slope: Slope | None) -> None:
        calls.append(t)
        if t > drive.t[999]:
            raise can.CanOperationError("bus off")

    listener = Listener(InlineWorker(Config()), broadcast)
    for message in drive[:1000].messages():
        listener(message)
    with pytest.raises(RoadloadError, match="the bus failed: bus off"):
        listener.__exit__(None, None, None)
    assert len(calls) > 1


def test_it_stops_once(drive: Frames) -> None:
    sent: list[can.Message] = []
    with Listener.of(Config(), sent.append) as listener:
        for message in drive[:1000].messages():
            listener(message)
        listener.stop()
        before = len(sent)
    assert len(sent) == before > 0


def test_it_counts_what_is_no_data_frame() -> None:
    listener = Listener.of(Config(), lambda message: None)
    listener(can.Message(timestamp=1.0, is_error_frame=True))
    listener(can.Message(timestamp=1.0, is_remote_frame=True))
    listener.stop()
    assert listener.skipped == {"error frame": 1, "remote frame": 1}


def test_messages_without_a_time_stamp_are_counted_and_not_kept() -> None:
    """Such a bus would fill the memory: no message is ever due."""
    worker = InlineWorker(Config())
    listener = Listener(worker, lambda t, estimate, slope: None)
    for _ in range(1000):
        listener(can.Message(arbitration_id=0x18FEF100, data=bytes(8)))
    listener.stop()
    assert listener.skipped == {"no time stamp (0 s)": 1000}
    assert worker.pipeline.traffic.frames == 0


def test_a_replayed_log_may_begin_at_zero(drive: Frames, tmp_path: Path) -> None:
    part = drive[:4000]
    write_log(dataclasses.replace(part, t=part.t - part.t[0]), tmp_path / "zero.log")
    run = replay([tmp_path / "zero.log"], Config())
    assert run.start == 0.0
    assert run.pipeline.traffic.frames == 4000
    assert not run.skipped


class Recorder:
    """A worker that only keeps the frames of each tick."""

    def __init__(self) -> None:
        self.ticks: list[Frames] = []
        self.latest: Estimate | None = None
        self.heard: float | None = None
        self.rows_until: float | None = None
        self.load_until = np.inf
        self.road_now: RoadAhead | None = None

    def offer(self, frames: Frames) -> None:
        self.ticks.append(frames)

    def close(self) -> None:
        """Nothing waits."""


@pytest.mark.parametrize(("step", "is_stale"), [(600.0, False), (1000.0, True), (-0.5, False), (-50.0, True)])
@pytest.mark.parametrize("is_new", [False, True])  # a listener after a change of the configuration
def test_an_estimate_of_before_a_long_silence_or_a_step_back_is_not_broadcast(
    step: float, is_stale: bool, is_new: bool
) -> None:
    worker, told = Recorder(), list[object]()
    worker.latest, worker.heard = made_estimate(t=99.0), 100.0

    def listening() -> Listener:
        return Listener(worker, lambda t, estimate, slope: told.append(estimate))

    listener = listening()
    before, after = (Frames.from_messages([can.Message(timestamp=t)]) for t in (100.0, 100.0 + step))
    listener.hear(before)
    listener.turn(100.25)
    listener = listening() if is_new else listener
    assert (listener.fresh(100.0 + step) is None) == is_stale  # before a frame comes, too
    listener.hear(after)
    listener.turn(100.0 + step)
    old, worker.latest = worker.latest, made_estimate(t=100.5 + step)
    listener.turn(101.0 + step)
    assert told == [old, None if is_stale else old, worker.latest]


def test_an_estimate_is_not_broadcast_after_long_without_speed_and_power_though_other_frames_come() -> None:
    worker, told = Recorder(), list[object]()
    worker.latest, worker.heard, worker.rows_until = made_estimate(t=99.0), 100.0, 98.0
    listener = Listener(worker, lambda t, estimate, slope: told.append(estimate))

    def turn(t: float) -> None:
        listener.hear(Frames.from_messages([can.Message(timestamp=t)]))
        listener.turn(t)

    for t in np.arange(100.0, 1100.0, 10.0):
        turn(float(t))
    known = [estimate is not None for estimate in told]
    assert known == [True] * 90 + [False] * 10
    worker.rows_until = 1099.0  # driving again, before the estimator knows of another load
    turn(1100.0)
    assert told[-1] is None
    worker.latest = made_estimate(t=1100.5)
    turn(1101.0)
    assert told[-1] is worker.latest


@pytest.mark.parametrize(("stop", "dwell"), [(300.0, 320.0), (15.0, 20.0)])
def test_the_mass_of_before_a_long_stop_is_not_broadcast_once_the_load_may_have_changed(
    stop: float, dwell: float
) -> None:
    """The stop ends before the rows after it are cut into strides, 20 s at a time."""
    rng = np.random.default_rng(4)
    road = generate_route("mixed", 20e3, rng)
    road = dataclasses.replace(road, stop_position=np.array([2000.0, 20e3]), stop_dwell=np.array([dwell, 0.0]))
    truth = record(Truck(mass=27_190.0, A=1739.0, C=3.74), road, 300.0 + dwell, rng)
    standing = EPOCH + truth.truth.t[truth.truth.v < Config().admission.minimum_speed_m_s]
    began, told = standing[standing > EPOCH + 100][0], list[tuple[float, Estimate | None, Slope | None]]()
    worker = InlineWorker(from_dict({**EAGER, "load": {"stop_s": stop}}))
    listener = Listener(worker, lambda t, estimate, slope: told.append((t, estimate, slope)))
    for message in frames_of(truth.signals).messages():
        listener(message)
    fresh = np.array([t for t, estimate, _ in told if estimate is not None and estimate.t < began + dwell])
    assert fresh[-1] == pytest.approx(began + stop, abs=1.0)
    assert max(t for t, _, slope in told if slope is not None and t < began + dwell + 40) < began + stop + 1.0


def test_an_estimate_is_not_broadcast_from_when_on_the_load_may_be_another() -> None:
    worker = Recorder()
    worker.latest, worker.heard, worker.load_until = made_estimate(t=99.0), 100.0, 400.0
    listener = Listener(worker, lambda t, estimate, slope: None)
    assert listener.fresh(399.9) is worker.latest
    assert listener.fresh(400.0) is None
    worker.load_until = 500.0  # it had moved on by then
    assert listener.fresh(401.0) is worker.latest


def test_daemon_and_replay_broadcast_the_same_bytes(
    drive: Frames, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The daemon is turned at the times at which a replay broadcasts; its address is claimed with the first frame."""
    IRRELEVANT.timestamp = float(drive.t[0]) - 0.5
    frames = Frames.concatenate([Frames.from_messages([IRRELEVANT]), drive])
    write_log(frames, tmp_path / "drive.blf")
    replayed = replay([tmp_path / "drive.blf"], TRANSMITTING)

    times: list[float] = []
    recorder = Recorder()
    listener = Listener(recorder, lambda t, estimate, slope: times.append(t))
    for message in frames.messages():
        listener(message)

    bench = Bench(config=TRANSMITTING, transmit=True)
    bench.ahead = 0.0
    offer = bench.worker.offer

    def work_at_once(frames: Frames) -> None:
        offer(frames)
        bench.worker.turn()

    monkeypatch.setattr(bench.worker, "offer", work_at_once)
    bench.now = IRRELEVANT.timestamp
    bench.link.step(0)
    ticks = [frames[:1], recorder.ticks[0][1:], *recorder.ticks[1:]]
    for t, tick in zip([IRRELEVANT.timestamp, *times], ticks, strict=True):
        bench.now = t
        bench.bus.waiting.append(Batch(frames=tick))
        bench.link.step(0)
        bench.daemon.turn()
    sent = [message for message in bench.bus.sent if message.arbitration_id >> 8 & 0x3FFFF in output_groups()]
    assert any(update.mass is not None for update in replayed.updates)
    assert as_bytes(sent) == as_bytes(replayed.broadcast)[: len(sent)]
    assert len(sent) >= len(replayed.broadcast) - 6  # all but those after the end of the traffic

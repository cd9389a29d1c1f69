"""The road under the vehicle as a listener broadcasts it, from CAN bytes to CAN bytes."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import can
import numpy as np
import pytest
from msgspec import UNSET
from numpy.testing import assert_allclose

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import EPOCH, frames_of
from estimator.can_io.log_writer import write_log
from estimator.can_io.publisher import output_database
from estimator.checkpoint.store import pack, unpack
from estimator.config import from_dict
from estimator.errors import StateError
from estimator.estimation.road_now import RoadAhead
from estimator.report import summary
from estimator.settings import Publish
from estimator.signals import Floats
from estimator.simulation.recording import Recording, record
from estimator.simulation.route import generate_route
from estimator.simulation.sensors import Sensors
from estimator.simulation.truck import Truck
from estimator.streaming.listener import TICK, InlineWorker, Listener, broadcast_by
from estimator.streaming.pipeline import Pipeline
from estimator.streaming.replay import replay

pytestmark = pytest.mark.slow

EAGER = from_dict({"gate": {"minimum_samples": 300}})
ROAD = 0xFF65
SECONDS = 900.0
Z90 = 1.645


@dataclass(frozen=True, kw_only=True)
class Heard:
    """Contents of the road's message by time since the start [s] (n,), NaN where not available."""

    t: Floats
    grade: Floats
    sd: Floats
    height: Floats
    height_sd: Floats
    status: list[str]


def recorded() -> Recording:
    rng = np.random.default_rng(11)
    truck = Truck(mass=27_190.0, A=1739.0, C=3.74)
    road = generate_route("mixed", 40.0 * SECONDS, rng, 0.012)
    return record(truck, road, SECONDS, rng, sensors=Sensors(altitude_noise=0.3))


@pytest.fixture(scope="module")
def drive() -> Recording:
    return recorded()


@pytest.fixture(scope="module")
def frames(drive) -> Frames:
    return frames_of(drive.signals)


def ticks(frames: Frames) -> Iterator[Frames]:
    edges = np.searchsorted(frames.t, np.arange(frames.t[0], frames.t[-1] + TICK, TICK)).tolist()
    yield from (frames[a:b] for a, b in pairwise(edges))


def broadcast(frames: Frames, silence: float = 0.0) -> tuple[list[can.Message], InlineWorker]:
    """What a listener sends, also in a ``silence`` [s] behind the traffic."""
    sent, worker = list[can.Message](), InlineWorker(EAGER)
    listener = Listener(worker, broadcast_by(Publish(), sent.append))
    for part in ticks(frames):
        listener.hear(part)
        listener.turn(float(part.t[-1]))
    for t in np.arange(0.0, silence, TICK):
        listener.turn(float(frames.t[-1] + t))
    return sent, worker


def heard(sent: list[can.Message]) -> Heard:
    frames = [message for message in sent if message.arbitration_id >> 8 & 0xFFFF == ROAD]
    values = [output_database().decode_message("RoadloadRoad", bytes(frame.data)) for frame in frames]

    def column(name: str) -> Floats:
        return np.array([value if isinstance(value := x[name], (int, float)) else np.nan for x in values])

    return Heard(
        t=np.array([frame.timestamp - EPOCH for frame in frames]),
        grade=column("RoadGrade"),
        sd=column("RoadGradeDeviation"),
        height=column("RoadHeight"),
        height_sd=column("RoadHeightDeviation"),
        status=[str(x["EstimateStatus"]) for x in values],
    )


@pytest.fixture(scope="module")
def sent(frames) -> tuple[list[can.Message], InlineWorker]:
    return broadcast(frames, silence=30.0)


@pytest.fixture(scope="module")
def road(sent) -> Heard:
    return heard(sent[0])


def test_it_is_sent_once_a_second(road):
    assert_allclose(np.diff(road.t), 1.0, atol=TICK)
    assert len(road.t) == pytest.approx(SECONDS + 30.0, abs=5)


def test_nothing_is_available_before_the_first_estimate(road, sent):
    first = next(update.t for update in sent[1].updates if update.mass is not None) - EPOCH
    assert first < 0.4 * SECONDS
    before = road.t < first
    assert np.isnan([road.grade[before], road.sd[before], road.height[before]]).all()
    assert {road.status[i] for i in np.flatnonzero(before)} == {"unestimated"}


def test_from_then_on_its_intervals_hold_the_grade_of_the_road(road, drive):
    there = np.isfinite(road.grade) & (road.t < SECONDS)
    assert there.sum() > 0.6 * SECONDS
    truth = 100 * np.interp(road.t[there], drive.truth.t, drive.truth.grade)
    error = road.grade[there] - truth
    assert 0.80 < np.mean(np.abs(error) < Z90 * road.sd[there]) < 0.99
    assert np.sqrt(np.mean(error**2)) < 0.7 * truth.std()


def test_the_height_is_that_above_the_start(road, drive):
    there = np.isfinite(road.height) & (road.t < SECONDS)
    rise = np.interp(road.t[there], drive.truth.t, drive.truth.altitude) - drive.truth.altitude[0]
    assert np.ptp(rise) > 10.0
    assert np.abs(road.height[there] - rise).max() < 4.0


def test_a_standing_vehicle_has_the_slope_of_the_place_where_it_stopped(drive, frames):
    halts = np.flatnonzero(np.diff((drive.truth.v < 0.01).astype(int)) == 1)
    stop = float(drive.truth.t[halts[drive.truth.t[halts] > 0.4 * SECONDS][0]])
    worker = InlineWorker(EAGER)
    for part in ticks(frames[frames.t < EPOCH + stop + 10.0]):
        worker.offer(part)
    ahead = worker.road_now
    assert ahead is not None
    assert ahead.speed == 0.0
    first, last = ahead.at(ahead.t), ahead.at(ahead.t + 10.0)
    assert first is not None
    assert last is not None
    assert (last.sine, last.sd) == (first.sine, first.sd)


def test_in_a_silence_nothing_is_available_after_twelve_seconds(road):
    silent = road.t > SECONDS + 12.0
    assert silent.sum() > 10
    assert np.isnan(road.grade[silent]).all()
    assert {road.status[i] for i in np.flatnonzero(silent)} == {"unestimated"}


def test_before_the_newest_row_nothing_is_known(sent):
    ahead = sent[1].road_now
    assert isinstance(ahead, RoadAhead)
    assert ahead.at(ahead.t - 60.0) is None
    assert ahead.at(ahead.t + 13.0) is None
    assert ahead.at(ahead.t + 5.0) is not None


def test_behind_a_gap_it_waits_for_a_new_stride(frames):
    worker = InlineWorker(EAGER)
    worker.offer(frames[frames.t < EPOCH + 600.0])
    assert worker.road_now is not None
    later = replace(frames, t=frames.t + 100.0)
    for seconds in (705.0, 708.0):
        worker.offer(later[(later.t > EPOCH + seconds - 5.0) & (later.t < EPOCH + seconds)])
        ahead = worker.road_now
        assert ahead is None or ahead.at(EPOCH + seconds) is None


def test_it_does_not_depend_on_how_the_frames_come(frames, sent):
    worker = InlineWorker(EAGER)
    worker.offer(frames)
    one, other = worker.road_now, sent[1].road_now
    assert one is not None
    assert other is not None
    assert (one.t, one.belief.t) == (other.t, other.belief.t)
    assert one.belief.mean[0] == pytest.approx(other.belief.mean[0], abs=1e-7)
    assert one.belief.covariance[0, 0] == pytest.approx(other.belief.covariance[0, 0], rel=1e-6)


def test_after_a_restart_the_height_is_still_that_above_the_start(drive, frames):
    saved, before = 600.0, Pipeline(EAGER, is_live=True)
    for part in ticks(frames[frames.t < EPOCH + saved]):
        list(before.feed(part))

    state = unpack(pack(before.state(), "k"), "k")
    after = Pipeline(EAGER, is_live=True)
    after.restore(state)
    assert after.road_now is None
    for part in ticks(frames[frames.t >= EPOCH + saved + 40.0]):
        list(after.feed(part))
    ahead = after.road_now
    assert ahead is not None
    slope = ahead.at(ahead.t)
    assert slope is not None
    rise = np.interp(slope.t - EPOCH, drive.truth.t, drive.truth.altitude) - drive.truth.altitude[0]
    assert abs(slope.height - rise) < 5.0
    assert slope.height_sd < 10.0


@pytest.mark.parametrize("heights", [[[1.0, 0.0, 1.0], [0.0, 0.0, 1.0]], [[0.0, 0.0, -1.0]]])
def test_heights_that_cannot_be_are_refused(heights):
    state = unpack(pack(Pipeline(EAGER, is_live=True).state(), "k"), "k")
    state["estimator"]["road"]["heights"] = np.array(heights)
    with pytest.raises(StateError, match="heights"):
        Pipeline(EAGER, is_live=True).restore(state)


def test_a_replay_records_the_road_and_tells_it_at_each_update(frames, sent, tmp_path):
    seconds = 600.0
    write_log(frames[frames.t < EPOCH + seconds], tmp_path / "drive.blf")
    run = replay([tmp_path / "drive.blf"], EAGER, output=tmp_path / "out.blf")
    with can.LogReader(tmp_path / "out.blf") as reader:
        recorded = heard([message for message in reader if message.arbitration_id >> 8 & 0xFFFF == ROAD])
    there = np.flatnonzero(np.isfinite(recorded.grade))
    assert len(there) > 0.6 * seconds
    assert there[-1] == len(recorded.t) - 1  # also when the log has ended
    assert recorded.status[-1] == "estimated"
    assert abs(recorded.grade[-1] - recorded.grade[there[-2]]) < 1.0
    updates = [update for update in summary.of_run(run).updates if update.road_now is not UNSET]
    assert len(updates) > 5
    for update in updates:
        nearest = there[np.argmin(np.abs(recorded.t[there] - update.t_s))]
        assert update.road_now.grade_percent == pytest.approx(recorded.grade[nearest], abs=0.25)
        assert update.road_now.height_m == pytest.approx(recorded.height[nearest], abs=2.0)

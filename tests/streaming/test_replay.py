"""The whole way on a virtual bus: frames in, estimate and broadcast out."""

from pathlib import Path

import can
import numpy as np
import pytest
from msgspec import UNSET
from msgspec.structs import replace

from estimator.answers.run import RunAnswer
from estimator.can_io.counter_crc import verify
from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.can_io.logs import open_log
from estimator.can_io.publisher import output_database
from estimator.config import from_dict
from estimator.report import summary
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.replay import Run, estimate_logs, replay

pytestmark = pytest.mark.slow

TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)
SPARSE = {"gate": {"interval_s": 250.0}}
CONFIG = from_dict(SPARSE)


def silent(share: float) -> None:
    assert 0 <= share <= 1


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(4)
    frames = frames_of(record(TRUCK, generate_route("mixed", 60e3, rng), 840.0, rng).signals)
    path = tmp_path_factory.mktemp("drive") / "drive.blf"
    write_log(frames, path)
    return path


@pytest.fixture(scope="module")
def run(drive: Path) -> Run:
    return replay([drive], CONFIG, silent, output=drive.with_name("broadcast.blf"))


def test_replay_recovers_the_truck(run: Run) -> None:
    final = run.final
    assert final.status == "estimated"
    assert final.mass is not None
    assert final.A is not None
    assert final.C is not None
    assert final.convergence is not None
    assert final.mass.mean == pytest.approx(TRUCK.mass, rel=0.02)
    for marginal, truth in ((final.mass, TRUCK.mass), (final.A, TRUCK.A), (final.C, TRUCK.C)):
        assert abs(marginal.mean - truth) < 3.5 * marginal.sd
        assert marginal.q05 < marginal.q50 < marginal.q95
    assert final.convergence.r_hat < 1.05


def without_slopes(answer: RunAnswer) -> RunAnswer:
    """Without what is broadcast of the road alone."""
    return replace(answer, updates=tuple(replace(update, road_now=UNSET) for update in answer.updates))


def test_replay_and_estimate_agree_to_the_last_bit(drive: Path, run: Run) -> None:
    answer = summary.of_run(run)
    assert any(update.road_now is not UNSET for update in answer.updates)  # of what was broadcast
    assert summary.of_run(estimate_logs([drive], CONFIG, silent)) == without_slopes(answer)


def test_a_log_up_to_a_second_out_of_order_gives_the_same_both_ways(drive: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    straight, late = tmp_path / "straight.csv", tmp_path / "late.csv"
    write_log(Frames.concatenate(list(open_log(drive)))[:40_000], straight)
    frames = Frames.concatenate(list(open_log(straight)))
    arrival = frames.t + rng.uniform(0, 0.99, len(frames))
    # Frames of equal time have no order but that of arrival, so they stay together.
    arrival = arrival[np.searchsorted(frames.t, frames.t)]
    write_log(frames[np.argsort(arrival, kind="stable")], late)
    want, got = (summary.of_run(estimate_logs([path], CONFIG, silent)) for path in (straight, late))
    assert without_slopes(summary.of_run(replay([late], CONFIG, silent))) == got
    assert got.frames.reordered > len(frames) / 2
    assert want.frames.reordered == 0
    assert got == replace(want, frames=replace(want.frames, reordered=got.frames.reordered))


def test_broadcast_says_what_was_estimated(drive: Path, run: Run) -> None:
    with can.LogReader(drive.with_name("broadcast.blf")) as reader:
        messages = list(reader)
    assert [bytes(m.data) for m in messages] == [bytes(m.data) for m in run.broadcast]
    assert all(verify(m) for m in messages)
    database = output_database()
    last = {m.arbitration_id: database.decode_message(m.arbitration_id, bytes(m.data)) for m in messages}
    by_name = {database.get_message_by_frame_id(i).name: values for i, values in last.items()}
    assert run.final.mass is not None
    assert by_name["RoadloadMass"]["MassMean"] == pytest.approx(run.final.mass.mean, abs=1.01)
    assert by_name["RoadloadStatus"]["EstimateStatus"] == "estimated"
    status = [m for m in messages if m.arbitration_id >> 8 & 0xFF == 0x60]
    assert np.diff([m.timestamp for m in status]).max() < 1.5
    # Nothing is claimed before the first estimate.
    first = run.updates[[u.status for u in run.updates].index("estimated")].t
    early = [m for m in messages if m.timestamp < first and m.arbitration_id >> 8 & 0xFF == 0x61]
    assert len(early) > 5
    assert all(bytes(m.data[:6]) == b"\xff" * 6 for m in early)


def test_seed_changes_draws_but_not_the_conclusion(drive: Path, run: Run) -> None:
    other = estimate_logs([drive], from_dict({"sampler": {"seed": 99}, **SPARSE}), silent).final
    assert other.mass is not None
    assert run.final.mass is not None
    assert other.mass.mean != run.final.mass.mean
    assert other.mass.mean == pytest.approx(run.final.mass.mean, abs=0.2 * run.final.mass.sd)


def test_logs_whose_times_follow_are_one_drive(drive: Path, run: Run, tmp_path: Path) -> None:
    frames = Frames.concatenate(list(open_log(drive)))
    middle = len(frames) // 2
    paths = [tmp_path / "1.blf", tmp_path / "2.blf"]
    for path, part in zip(paths, (frames[:middle], frames[middle:]), strict=True):
        write_log(part, path)
    joined = estimate_logs(paths, CONFIG, silent).final
    assert joined.mass is not None
    assert run.final.mass is not None
    assert joined.mass.mean == pytest.approx(run.final.mass.mean, abs=0.3 * run.final.mass.sd)
    swapped = estimate_logs(paths[::-1], CONFIG, silent)
    assert swapped.final.admitted < 0.8 * run.final.admitted
    assert len(swapped.pipeline.traffic.rows.gaps) >= 1

"""From frames to estimates: truth from a simulated drive, however its frames come in, and whatever time does."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import EPOCH, frames_of
from estimator.can_io.time_order import NO_TIME
from estimator.config import J1939_BINDING, from_dict
from estimator.errors import MissingInputsError
from estimator.estimates import Estimate, Status
from estimator.preparation.admission import Reason
from estimator.signals import Role
from estimator.simulation.recording import Recording, record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.pipeline import Pipeline
from estimator.streaming.row_stream import MIN_NEW_DRIVE_SILENCE

TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)  # the dyno truth of the paper
MINUTES = 16
EAGER = {
    "gate": {"interval_s": 200, "minimum_samples": 300, "coverage": 0.0, "minimum_cells": 1, "relative_sd": [9, 9, 9]}
}
SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (1, 2))]


def recorded(minutes: float, seed: int, grade_sd: float = 0.0) -> Recording:
    rng = np.random.default_rng(seed)
    return record(TRUCK, generate_route("mixed", 1500 * minutes, rng, grade_sd), 60 * minutes, rng)


@pytest.fixture(scope="module")
def drive() -> Frames:
    return frames_of(recorded(MINUTES, 1).signals)


@pytest.fixture(scope="module")
def short(drive) -> Frames:
    return between(drive, 0, 360)


def moved(frames: Frames, by: float) -> Frames:
    return replace(frames, t=frames.t + by)


def between(frames: Frames, low: float, high: float) -> Frames:
    return frames[(frames.t >= EPOCH + low) & (frames.t < EPOCH + high)]


def run(parts, **tables) -> tuple[Pipeline, list[Estimate]]:
    pipeline = Pipeline(from_dict(tables))
    updates = [update for part in parts for update in pipeline.feed(part)]
    return pipeline, [*updates, *pipeline.finish()]


def near(estimate: Estimate, m: float = 0.02, A: float = 0.10, C: float = 0.08) -> bool:
    return (
        estimate.status == Status.ESTIMATED
        and abs(estimate.mass.mean / TRUCK.mass - 1) < m
        and abs(estimate.A.mean / TRUCK.A - 1) < A
        and abs(estimate.C.mean / TRUCK.C - 1) < C
    )


# Truth


@pytest.mark.slow
def test_truth_comes_back_through_frames(drive):
    pipeline, updates = run([drive])
    final = updates[-1]
    assert near(final)
    assert final.convergence.r_hat < 1.05
    assert final.mass.q05 < final.mass.q50 < final.mass.q95
    assert final.rms < 10e3
    assert pipeline.traffic.frames == len(drive)
    assert len(updates) > 0.75 * MINUTES
    pipeline.traffic.require_inputs("drive")
    estimator = pipeline.estimator
    rejected = {r: n for r, n in estimator.rejected.items() if r != Reason.EVICTED}
    assert estimator.window.added + sum(rejected.values()) == pytest.approx(MINUTES * 600, abs=3)
    assert {Reason.STANDING, Reason.BRAKING, Reason.SHIFTING, Reason.NEAR_EXCLUDED} <= set(rejected)


@pytest.mark.slow
@pytest.mark.parametrize(
    "sampler",
    [
        {"kernel": "random_walk", "chains": 8, "burn_in": 300, "draws": 1500},
        {"likelihood": "paper"},
    ],
    ids=["random walk", "paper"],
)
def test_other_samplers_agree(drive, sampler):
    final = run([drive], sampler=sampler, gate={"interval_s": 3600})[1][-1]
    # The paper's likelihood knows nothing of noise in the regressors.
    assert near(final, 0.05, 0.2, 0.2) if sampler.get("likelihood") == "paper" else near(final)


@pytest.mark.slow
def test_the_papers_own_sampler(drive):
    sampler = {"likelihood": "paper", "kernel": "random_walk", "chains": 3, "burn_in": 300, "draws": 1500}
    final = run([between(drive, 0, 900)], sampler=sampler, gate={**EAGER["gate"], "interval_s": 3600})[1][-1]
    assert near(final, 0.1, 0.4, 0.4)
    assert final.convergence.chains == 3


@pytest.mark.slow
def test_the_seed_decides(short):
    part = short
    one, same, other = (run([part], sampler={"seed": seed}, **EAGER)[1] for seed in (5, 5, 6))
    assert one == same
    assert one[-1].mass.mean != other[-1].mass.mean
    assert one[-1].mass.mean == pytest.approx(other[-1].mass.mean, abs=one[-1].mass.sd)


# How frames come in


def pieces(frames: Frames, cuts) -> list[Frames]:
    bounds = [0, *sorted(cuts), len(frames)]
    return [frames[a:b] for a, b in pairwise(bounds)]


@pytest.mark.slow
def test_one_by_one_or_all_at_once_is_the_same_to_the_bit(short):
    """Around an update; the frames before and after come at once."""
    part = between(short, 0, 300)
    alone = slice(*np.searchsorted(part.t, [EPOCH + 190, EPOCH + 230]))
    whole = run([part], **EAGER)
    single = run(pieces(part, range(alone.start, alone.stop + 1)), **EAGER)
    assert EPOCH + 195 < whole[1][0].t < EPOCH + 225
    assert whole[1][-1].status == Status.ESTIMATED
    assert single[1] == whole[1]
    assert single[0].estimator.rejected == whole[0].estimator.rejected
    assert single[0].traffic.rows.gaps == whole[0].traffic.rows.gaps


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_batches_of_any_size_are_the_same_to_the_bit(short, seed):
    rng = np.random.default_rng(seed)
    gappy = short[(short.t < EPOCH + 250) | (short.t > EPOCH + 295)]
    random = pieces(gappy, rng.integers(0, len(gappy), int(rng.integers(5, 300))))
    assert run(random, **EAGER)[1] == run([gappy], **EAGER)[1]


@pytest.mark.slow
def test_two_halves_with_following_times_are_the_whole(drive):
    first, second = between(drive, 0, 400), between(drive, 400, 800)
    whole = run([between(drive, 0, 800)], **EAGER)[1][-1]
    assert run([first, second], **EAGER)[1][-1] == whole
    # As two loggers' files with their own clocks, the second a few seconds later.
    later = run([first, moved(second, 8.0)], **EAGER)[1][-1]
    for part in ("mass", "A", "C"):
        assert getattr(later, part).mean == pytest.approx(getattr(whole, part).mean, abs=getattr(whole, part).sd)


# What time does


@pytest.mark.slow
def test_a_silence_is_a_gap_and_not_bridged(short):
    pipeline, updates = run([between(short, 0, 200), moved(between(short, 200, 360), 100)])
    gaps = pipeline.traffic.rows.gaps
    assert any(a == pytest.approx(EPOCH + 200, abs=1) and b == pytest.approx(EPOCH + 300, abs=1) for a, b in gaps)
    strides = pipeline.estimator.window.strides
    t = strides.t[strides.known] - EPOCH
    assert not np.any((t > 199.5) & (t < 300.5))  # strides of a second, by their middle
    assert np.any(t < 195)
    assert np.any(t > 305)
    assert any(update.t == pytest.approx(EPOCH + 200, abs=1) for update in updates)


@pytest.mark.slow
@pytest.mark.parametrize("batch", [None, 1000, 1])
def test_a_silence_at_the_edge_of_a_batch(short, batch):
    parts = [between(short, 0, 60), moved(between(short, 60, 70), 40)]
    if batch:
        parts = [part[i : i + batch] for part in parts for i in range(0, len(part), batch)]
    pipeline, _ = run(parts)
    assert [round(b - a) for a, b in pipeline.traffic.rows.gaps if b - a > 1] == [40]


@pytest.mark.slow
def test_one_signal_missing_for_a_while_is_a_gap(short):
    speed = (short.ident >> 8) & 0xFFFF == 0xFEF1  # CCVS1
    out = (short.t > EPOCH + 100) & (short.t < EPOCH + 110)
    pipeline, _ = run([short[~(speed & out)]])
    assert [(round(a - EPOCH), round(b - EPOCH)) for a, b in pipeline.traffic.rows.gaps if b - a > 1] == [(100, 110)]
    assert pipeline.estimator.rejected[Reason.SPEED_STALE] >= 98


@pytest.mark.slow
@pytest.mark.parametrize(("silence", "kept"), [(200, True), (MIN_NEW_DRIVE_SILENCE + 60, False)])
def test_a_long_silence_starts_a_new_window(short, silence, kept):
    pipeline, _ = run([between(short, 0, 300), moved(between(short, 300, 360), silence)])
    t = pipeline.estimator.window.strides.t - EPOCH
    assert np.any(t < 300) == kept
    assert np.any(t > 300 + silence)
    assert any(b - a == pytest.approx(silence, abs=2) for a, b in pipeline.traffic.rows.gaps)


@pytest.mark.slow
def test_a_step_back_of_an_hour(short):
    parts = [between(short, 0, 300), moved(between(short, 300, 360), -3600)]
    pipeline, updates = run(parts)
    gaps = pipeline.traffic.rows.gaps
    assert any(a == pytest.approx(EPOCH + 300, abs=1) and b == pytest.approx(EPOCH - 3300, abs=1) for a, b in gaps)
    assert updates[-1].t < EPOCH
    assert np.all(pipeline.estimator.window.strides.t < EPOCH)
    assert len(pipeline.estimator.window) > 0


@pytest.mark.slow
def test_duplicates_change_nothing(short):
    # All but transport packets, whose second copy would be out of sequence.
    packet = (short.ident >> 16) & 0xFE == 0xEA
    twice = short[np.repeat(np.arange(len(short)), np.where(packet, 1, 2))]
    once = run([short], **EAGER)[1][-1]
    assert run([twice], **EAGER)[1][-1] == once


@pytest.mark.slow
@pytest.mark.parametrize("seed", SEEDS)
def test_frames_up_to_a_second_late_change_nothing(short, seed):
    rng = np.random.default_rng(seed)
    part = short[np.unique(short.t, return_index=True)[1]]  # frames of equal time have no order but that of arrival
    order = np.argsort(part.t + rng.uniform(0, 0.9999, len(part)), kind="stable")
    cuts = np.sort(rng.integers(0, len(part), 40))
    straight, late = run([part], **EAGER), run(pieces(part[order], cuts), **EAGER)
    assert late[1] == straight[1]
    assert late[1][-1].status == Status.ESTIMATED
    assert late[0].traffic.rows.gaps == straight[0].traffic.rows.gaps
    assert late[0].traffic.errors == straight[0].traffic.errors
    assert late[0].traffic.order.reordered > len(part) / 2
    assert straight[0].traffic.order.reordered == 0


@pytest.mark.slow
def test_transport_packets_recorded_as_a_whole(short):
    """A gateway that writes the announcement and all packets of a broadcast when the last of them has come."""
    transport = np.isin(short.ident >> 16 & 0xFF, [0xEB, 0xEC])
    written = short.t.copy()
    last = short.t[transport].reshape(-1, 7)[:, -1]  # one announcement and six packets
    written[transport] = np.repeat(last, 7)
    arriving = short[np.argsort(written, kind="stable")]
    assert np.any(np.diff(arriving.t) < 0)
    assert run([arriving], **EAGER)[1] == run([short], **EAGER)[1]


@pytest.mark.slow
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf"), 1e17, 1e300, -1e300])
def test_frames_without_a_usable_time_are_counted_and_change_nothing(short, bad):
    part = between(short, 0, 120)
    t = np.insert(part.t, [0, 500, len(part)], bad)
    rows = np.insert(np.arange(len(part)), [0, 500, len(part)], 0)
    pipeline, updates = run([replace(part[rows], t=t)], **EAGER)
    straight = run([part], **EAGER)
    assert updates == straight[1]
    assert pipeline.traffic.errors - straight[0].traffic.errors == {NO_TIME: 3}


@pytest.mark.slow
def test_the_pipeline_goes_on_after_its_end(short):
    pipeline = Pipeline(from_dict(EAGER))
    list(pipeline.feed(between(short, 0, 240)))
    assert list(pipeline.finish())
    list(pipeline.feed(between(short, 240, 360)))
    list(pipeline.finish())
    assert pipeline.traffic.frames == len(short)
    assert list(pipeline.finish()) == []


def test_no_frames_at_all():
    pipeline = Pipeline(from_dict({}))
    empty = Frames.concatenate([])
    assert list(pipeline.feed(empty)) == []
    assert list(pipeline.finish()) == []
    with pytest.raises(MissingInputsError):
        pipeline.traffic.require_inputs("nothing")


# What is missing


def without(frames: Frames, pgn: int) -> Frames:
    pgns = (frames.ident >> 8) & 0x3FFFF
    destined = (pgns & 0xFF00) < 0xF000
    return frames[np.where(destined, pgns & 0x3FF00, pgns) != pgn]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pgn", "name"),
    [
        (0xF004, "EEC1.EngSpeed"),
        (0xFEF1, "CCVS1.WheelBasedVehicleSpeed"),
        (0xFEDF, "EEC3.NominalFrictionPercentTorque"),
        (0xEC00, "EC1.EngReferenceTorque"),
    ],
)
def test_missing_inputs_are_named(short, pgn, name):
    pipeline, updates = run([without(between(short, 0, 60), pgn)])
    with pytest.raises(MissingInputsError, match=name) as error:
        pipeline.traffic.require_inputs("here")
    assert str(error.value).startswith("here: missing inputs: ")
    assert all(update.status == Status.UNESTIMATED for update in updates)


def test_what_the_configuration_adds_is_required(short):
    part = between(short, 0, 60)
    run([part])[0].traffic.require_inputs("here")
    known = run([without(part, 0xEC00)], vehicle={"reference_torque_Nm": 2500.0})[0]
    known.traffic.require_inputs("here")


def test_values_that_are_never_available_are_named(short):
    part = between(short, 0, 60)
    speed = (part.ident >> 8) & 0xFFFF == 0xFEF1
    part.data[speed, 1:3] = 0xFF
    with pytest.raises(MissingInputsError, match=r"missing inputs: CCVS1\.WheelBasedVehicleSpeed"):
        run([part])[0].traffic.require_inputs("here")


# Vehicles with other signals


@pytest.mark.slow
def test_wheel_speeds_stand_in_for_speed(drive):
    binding = {role: signal for role, signal in J1939_BINDING.items() if role != Role.SPEED}
    binding[Role.WHEEL_SPEEDS] = ["EBC2.FrontAxleSpeed"]
    assert near(run([drive], signals=binding, gate={"interval_s": 3600})[1][-1])


@pytest.mark.slow
def test_driveline_efficiency_scales_the_parameters(short):
    whole, part_of = (run([short], vehicle={"driveline_efficiency": e}, **EAGER)[1][-1] for e in (1.0, 0.9))
    assert part_of.mass.mean == pytest.approx(0.9 * whole.mass.mean, rel=0.01)

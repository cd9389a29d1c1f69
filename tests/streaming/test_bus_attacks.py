"""Other nodes that lie, copy or replace the vehicle's: the estimate is unharmed or withheld, and comes back."""

import json

import can
import numpy as np
import pytest
from bus_attacks.catalogue import Attack, attacks
from bus_attacks.trial import Look, attempt, deviations, look_at
from project_paths import ROOT

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import EPOCH, frames_of
from estimator.can_io.publisher import output_database
from estimator.config import Config
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.listener import InlineWorker, Listener, broadcast_by
from estimator.streaming.row_stream import RowStream

pytestmark = pytest.mark.slow
NIGHTLY = pytest.mark.nightly

TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)
MINUTES, LONG = 13.0, 18.0
ATTACKS = {attack.name: attack for attack in attacks()}
# Made the mass wrong, or silenced the daemon for good, when the first valid sender was believed for ever.
HARMFUL = (
    "one foreign EC1 of 3,250 Nm before the vehicle's first frame",
    "the engine's controller changes its address",
    "EEC1 torque x 1.3 in turn, same address, throughout",
    "EC1 3,250 Nm after each, other address, throughout",
)
HARMFUL_LIKE_THESE = (
    "one foreign EEC1 before the vehicle's first frame",
    "one foreign CCVS1 before the vehicle's first frame",
    "EEC1 torque x 1.3 at ten times the rate, same address, throughout",
    "CCVS1 speed x 1.1 in turn, same address, throughout",
    "EC1 3,250 Nm after each, same address, throughout",
)
PASSING = (
    "EEC1 torque x 1.3 at random times, same address, in the middle",
    "CCVS1 speed x 1.03 in turn, same address, in the middle",
    "EC1 3,250 Nm after each, other address, in the middle",
    "CCVS1 brake switch off right after each, same address, in the middle",
)
NOTICED = 30.0  # s within which the estimate is withheld: what is forged shows only while the vehicle works
BACK = 90.0  # s after the end of an attack within which the estimate is there again


def driven(minutes: float) -> Frames:
    rng = np.random.default_rng(1)
    return frames_of(record(TRUCK, generate_route("mixed", 2000 * minutes, rng), 60 * minutes, rng).signals)


@pytest.fixture(scope="module")
def drive() -> Frames:
    return driven(MINUTES)


@pytest.fixture(scope="module")
def long_drive() -> Frames:
    return driven(LONG)


def looks_at_honest(drive: Frames) -> list[Look]:
    looks = look_at(drive, Config())
    assert sum(look.is_estimated for look in looks) > 60
    assert not any(look.contested for look in looks)
    return looks


@pytest.fixture(scope="module")
def clean(drive: Frames) -> list[Look]:
    return looks_at_honest(drive)


@pytest.fixture(scope="module")
def long_clean(long_drive: Frames) -> list[Look]:
    return looks_at_honest(long_drive)


def test_an_honest_drive_loses_no_reading(drive: Frames):
    stream = RowStream(Config())
    for _ in (*stream.feed(drive), *stream.finish()):
        pass
    assert not stream.errors


@pytest.mark.parametrize("name", [*HARMFUL, *(pytest.param(name, marks=NIGHTLY) for name in HARMFUL_LIKE_THESE)])
def test_no_attack_makes_a_wrong_mass_estimated(drive: Frames, clean: list[Look], name: str):
    outcome = attempt(ATTACKS[name], drive, clean, TRUCK, Config())
    assert outcome.verdict in ("unharmed", "withheld")
    if "throughout" in name:
        assert outcome.looks == 0
        assert outcome.contested_for
    else:
        assert outcome.looks > 20


@pytest.mark.nightly
@pytest.mark.parametrize("when", ["throughout", "in the middle"])
def test_lone_wrong_speeds_do_no_harm(long_drive: Frames, long_clean: list[Look], when: str):
    attack = ATTACKS[f"CCVS1 speed x 1.3, one frame in forty, same address, {when}"]
    outcome = attempt(attack, long_drive, long_clean, TRUCK, Config())
    assert outcome.verdict == "unharmed"
    assert outcome.looks > 60
    assert outcome.worst_sd < max(deviations(long_clean, TRUCK)) + 0.3


@pytest.mark.nightly
@pytest.mark.parametrize("name", PASSING)
def test_an_attack_that_ends_leaves_nothing_behind(long_drive: Frames, long_clean: list[Look], name: str):
    outcome = attempt(ATTACKS[name], long_drive, long_clean, TRUCK, Config())
    assert outcome.verdict == "withheld"
    assert outcome.withheld_after_s is not None
    assert outcome.withheld_after_s <= NOTICED
    assert outcome.back_after_s is not None
    assert outcome.back_after_s <= BACK
    assert outcome.contested_for


def test_a_receiver_reads_not_available_while_an_input_is_contested(drive: Frames):
    """On a virtual bus: every mass frame of the attack, and none of the minute before it."""
    attack = Attack(name="late", apply=ATTACKS[PASSING[2]].apply, shares=(0.65, 0.82))
    frames, start, stop = attack.on(drive)
    sent: list[can.Message] = []
    listener = Listener.of(Config(), sent.append)
    for message in frames.messages():
        listener.on_message_received(message)
    layout = output_database().get_message_by_name("RoadloadMass")
    mass = {
        m.timestamp: layout.decode(bytes(m.data))["MassMean"]
        for m in sent
        if m.arbitration_id >> 8 & 0x3FFFF == layout.frame_id >> 8 & 0x3FFFF
    }
    before = [value for t, value in mass.items() if start - 60 < t < start]
    during = [value for t, value in mass.items() if start + 10 < t < stop]
    after = [value for t, value in mass.items() if t > stop + BACK]
    assert len(before) >= 5
    assert all(isinstance(value, float | int) for value in [*before, *after])
    assert len(during) >= 10
    assert {str(value) for value in during} == {"not available"}
    assert after[-1] == pytest.approx(TRUCK.mass, rel=0.03)


def test_what_is_kept_has_every_attack_and_no_wrong_estimate():
    kept = json.loads((ROOT / "results" / "attacks.json").read_bytes())["figures"]["attacks"]
    assert [one["attack"] for one in kept] == list(ATTACKS)
    assert {one["outcome"] for one in kept} == {"unharmed", "withheld"}


def test_the_same_attack_gives_the_same_contests_however_frames_arrive(drive: Frames):
    frames, _, _ = ATTACKS[PASSING[2]].on(drive[drive.t < EPOCH + 300])
    whole = look_at(frames, Config())
    worker = InlineWorker(Config())
    with Listener(worker, broadcast_by(Config().publish, lambda message: None)) as listener:
        for message in frames.messages():
            listener.on_message_received(message)
    assert worker.pipeline.traffic.contested == whole[-1].contested
    assert any("contested, " in reason for reason in worker.pipeline.traffic.errors)

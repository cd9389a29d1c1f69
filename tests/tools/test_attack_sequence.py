"""Attacks one after the other on one drive: their order and times, and what is made of the values that were heard."""

import json
from itertools import pairwise
from pathlib import Path

import can
import numpy as np
import pytest
from attack_sequence import (
    HELD,
    LEAD,
    SLOT,
    Heard,
    Slot,
    Values,
    chosen,
    in_sequence,
    on_a_drive,
    result_on_a_drive,
    results,
    throughout,
)
from attacks_vm import Play, Row, has_ended, heard_in, rows_of, summary, summed, with_earlier
from bus_attacks.catalogue import attacks
from bus_attacks.forging import announcements

from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.publisher import output_database
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck

TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)
TRUE: Values = {"mass": (27_190.0, 100.0), "A": (1739.0, 50.0), "C": (3.74, 0.1)}
FIRST, BEGAN = 1000.0, 5000.0  # s, of the drive and of the machine's clock
DRIVE = Play("", Frames.from_messages([can.Message(timestamp=FIRST), can.Message(timestamp=FIRST + 100.0)]), [])
SLOTS = [Slot(name="one", start=100.0, stop=140.0, end=190.0)]


def heard(withheld: tuple[float, float] = (0, 0), wrong: tuple[float, float] = (0, 0), off: float = 0.0) -> list[Heard]:
    """Values every 5 s for 300 s; none, and wrong ones, between the given times."""
    found = []
    for t in np.arange(0.0, 300.0, 5.0).tolist():
        mass = (27_190.0 + (off if wrong[0] <= t < wrong[1] else 0.0), 100.0)
        found.append(Heard(t, None if withheld[0] <= t < withheld[1] else TRUE | {"mass": mass}))
    return found


def test_all_attacks_that_begin_in_the_middle_follow_each_other_those_of_a_signal_apart() -> None:
    order = chosen()
    assert {one.name for one in order} == {one.name for one in attacks() if one.shares[0] > 0}
    signals = [" ".join(one.name.split()[:2]) for one in order]
    repeated = next(k for k, (one, other) in enumerate(pairwise(signals)) if one == other)
    assert len(set(signals[repeated:-1])) == 1  # there is no other left to be put between
    assert order[-1].name == "the engine's controller changes its address"


@pytest.mark.slow
def test_each_attack_changes_its_own_part_of_the_drive() -> None:
    rng = np.random.default_rng(1)
    drive = frames_of(record(TRUCK, generate_route("mixed", 30_000, rng), LEAD + 2 * SLOT + 60, rng).signals)
    order = [one for one in chosen() if "torque x 1.3 in turn" in one.name or "speed x 1.1 in turn" in one.name]
    frames, slots = in_sequence(drive, order)
    assert [slot.start - drive.t[0] for slot in slots] == [LEAD, LEAD + SLOT]
    assert [slot.stop - slot.start for slot in slots] == [HELD, HELD]
    for slot in slots:
        inside = (frames.t >= slot.start) & (frames.t < slot.stop)
        assert inside.sum() > ((drive.t >= slot.start) & (drive.t < slot.stop)).sum() + 5 * HELD
    outside = (frames.t < slots[0].start) | (frames.t > slots[0].stop + 1) & (frames.t < slots[1].start)
    same = (drive.t < slots[0].start) | (drive.t > slots[0].stop + 1) & (drive.t < slots[1].start)
    np.testing.assert_array_equal(frames.data[outside], drive.data[same])


@pytest.mark.slow
def test_an_attack_of_one_moment_ends_when_it_begins() -> None:
    rng = np.random.default_rng(1)
    drive = frames_of(record(TRUCK, generate_route("mixed", 30_000, rng), LEAD + SLOT, rng).signals)
    order = [one for one in chosen() if one.name == "one foreign EC1 of 3,250 Nm"]
    frames, (slot,) = in_sequence(drive, order)
    assert slot.stop == slot.start
    assert 0 < len(frames) - len(drive) < 10


@pytest.mark.parametrize(
    ("looks", "verdict"),
    [
        (heard(), "unharmed"),
        (heard(withheld=(110, 150)), "withheld"),
        (heard(withheld=(110, 300)), "withheld"),
        (heard(wrong=(120, 125), off=450.0), "silently biased"),
        (heard(withheld=(110, 150), wrong=(150, 155), off=-450.0), "silently biased"),
        (heard(wrong=(120, 125), off=350.0), "unharmed"),
        (heard(withheld=(0, 150)), "no estimate without it"),
    ],
)
def test_verdicts(looks: list[Heard], verdict: str) -> None:
    (result,) = results(looks, SLOTS, TRUCK)
    assert result.verdict == verdict


def test_times_to_withhold_and_to_come_back() -> None:
    (result,) = results(heard(withheld=(110, 160)), SLOTS, TRUCK)
    assert (result.withheld_after, result.back_after) == (10.0, 20.0)
    (never,) = results(heard(withheld=(110, 300)), SLOTS, TRUCK)
    assert (never.withheld_after, never.back_after) == (10.0, None)


def test_an_attack_that_was_not_heard_to_its_end_has_no_result() -> None:
    assert results(heard()[:35], SLOTS, TRUCK) == []


@pytest.fixture
def bus_log(tmp_path: Path) -> Path:
    """A folder with what was heard: a mass 7 and 11 s after the start of the drive, and "not available" after 22 s."""
    layout = output_database().get_message_by_name("RoadloadMass")
    filled = {"AliveCounter": 0, "EstimateStatus": 0, "Checksum": 0}
    known = layout.encode(filled | {"MassMean": 27_000, "MassQ05": 26_836, "MassQ95": 27_164})
    with can.CanutilsLogWriter(tmp_path / "broadcast.log") as log:
        for t, data in ((7.0, known), (11.0, known), (22.0, b"\xff" * 8)):
            log.on_message_received(
                can.Message(timestamp=BEGAN + t, arbitration_id=layout.frame_id, data=data, is_extended_id=True)
            )
    return tmp_path


def test_attacks_that_begin_with_the_drive_have_one_of_each_signal_first() -> None:
    order = throughout()
    assert {one.name for one in order} == {one.name for one in attacks()} - {one.name for one in chosen()}
    signals = [" ".join(one.name.split()[:2]) for one in order]
    kinds = len(set(signals))
    assert len(set(signals[:kinds])) == kinds


@pytest.mark.parametrize(
    ("looks", "verdict", "withheld_after", "back_after"),
    [
        (heard(), "unharmed", None, None),
        (heard(withheld=(0, 300)), "withheld", 150.0, None),
        (heard(withheld=(0, 180)), "withheld", 150.0, 180.0),
        (heard(wrong=(0, 300), off=450.0), "silently biased", None, None),
    ],
)
def test_an_attack_that_begins_with_the_drive_is_held_against_the_drive_without_it(
    looks: list[Heard], verdict: str, withheld_after: float | None, back_after: float | None
) -> None:
    slot = Slot(name="one", start=0.0, stop=0.0, end=300.0)
    result = result_on_a_drive(looks, heard(withheld=(0, 150)), slot, TRUCK)
    assert (result.verdict, result.withheld_after, result.back_after) == (verdict, withheld_after, back_after)


def test_without_an_estimate_on_the_drive_without_an_attack_nothing_is_said() -> None:
    slot = Slot(name="one", start=0.0, stop=300.0, end=300.0)
    none = heard(withheld=(0, 300))
    assert result_on_a_drive(none, none, slot, TRUCK).verdict == "no estimate without it"


def test_a_foreign_frame_before_the_drive_is_an_attack_of_one_moment() -> None:
    rng = np.random.default_rng(1)
    drive = frames_of(record(TRUCK, generate_route("mixed", 3000, rng), 60.0, rng).signals)
    (attack,) = [one for one in throughout() if one.name.startswith("one foreign EEC1")]
    frames, slot = on_a_drive(drive, attack)
    assert frames.t[0] < drive.t[0] == slot.start == slot.stop
    assert len(frames) == len(drive) + 1


def test_values_are_read_from_the_log_of_the_bus_and_are_gone_when_none_is_sent(bus_log: Path) -> None:
    (bus_log / "played.json").write_text(json.dumps({"began_s": BEGAN}))
    found = heard_in(bus_log, DRIVE)
    assert [one.t - FIRST for one in found] == [0.0, 5.0, 10.0, 15.0, 20.0]
    assert [one.values is None for one in found] == [True, True, False, False, True]
    assert found[2].values is not None
    mean, sd = found[2].values["mass"]
    assert (mean, round(sd)) == (27_000.0, 100)


@pytest.mark.parametrize(
    ("content", "ended"), [("", False), ('{"began_s": 1.0}', False), ('{"began_s": 1.0, "ended_s": 2.0}', True)]
)
def test_a_drive_in_which_the_machine_stopped_has_not_ended(content: str, ended: bool, tmp_path: Path) -> None:
    assert not has_ended(tmp_path, DRIVE)
    (tmp_path / "played.json").write_text(content)
    assert has_ended(tmp_path, DRIVE) == ended


def test_a_service_that_falls_silent_is_heard_as_withheld_to_the_end_of_the_drive(bus_log: Path) -> None:
    (bus_log / "played.json").write_text(json.dumps({"began_s": BEGAN, "ended_s": BEGAN + 100.0}))
    found = heard_in(bus_log, DRIVE)
    assert found[-1] == Heard(FIRST + 100.0, None)


def test_the_table_counts_outcomes_and_those_that_differ() -> None:
    one = results(heard(withheld=(110, 150)), SLOTS, TRUCK)
    other = results(heard(), SLOTS, TRUCK)
    found = summed({"runs": ["so many frames."], "attacks": rows_of([*one, *other], [*one, *one])})
    assert [found[key] for key in ("attacks", "unharmed", "withheld", "silently biased")] == [2, 1, 1, 0]
    assert (found["outcome as in process"], found["runs"]) == (1, "so many frames.")


def row(attack: str, outcome: str, worst: float | None, in_process: str) -> Row:
    return {"attack": attack, **became(outcome, worst), "in_process": became(in_process)}


def became(outcome: str, worst: float | None = None) -> Row:
    return {"outcome": outcome, "withheld_after_s": None, "back_after_s": None, "worst_sd": worst}


def test_a_table_keeps_the_rows_of_attacks_that_were_not_played_again() -> None:
    a, c = row("a", "withheld", 3.0, "unharmed"), row("c", "unharmed", 9.0, "unharmed")
    new = [row("b", "unharmed", 1.0, "unharmed"), row("c", "withheld", None, "withheld")]
    first = {"runs": ["first run."], "attacks": [a, c]}
    both = with_earlier(new, "second run.", first, ["a", "b", "c"])
    assert both == {"runs": ["first run.", "second run."], "attacks": [a, *new]}
    found = summed(both)
    assert [found[key] for key in ("attacks", "unharmed", "withheld", "silently biased")] == [3, 1, 2, 0]
    assert (found["largest deviation"], found["outcome as in process"]) == ("3.0 sd", 2)
    again = with_earlier([*new, a], "second run.", both, ["a", "b", "c"])
    assert again == {"runs": ["second run."], "attacks": [a, *new]}


def test_real_and_forged_broadcasts_of_the_reference_torque_do_not_overlap() -> None:
    rng = np.random.default_rng(1)
    drive = frames_of(record(TRUCK, generate_route("mixed", 3000, rng), 60.0, rng).signals)
    (attack,) = [one for one in throughout() if one.name.startswith("EC1 3,250 Nm after each, same address")]
    frames, _ = on_a_drive(drive, attack)
    announced = announcements(frames, "EC1")
    assert len(announced) == 2 * len(announcements(drive, "EC1"))
    assert np.diff(announced.t).min() > 2.0  # s; a broadcast takes 0.3 s


def a_status(t: float, frames: int, pid: int = 7) -> str:
    status = {"pid": pid, "written_s": t, "input": {"frames": frames, "kernel_drops": 2, "queue_drops": 1}}
    return json.dumps(status | {"estimator": {"queue_drops": 3}})


@pytest.mark.parametrize(
    ("ended", "cut", "said"),
    [
        ({"ended_s": BEGAN + 20}, "", "6 of 2,000 received frames were lost; 1 restarts of the service."),
        (
            {},
            '{"pid": 8, "wri',
            "6 of 2,000 received frames were lost; 1 restarts of the service. "
            "The run was ended after 15 of 100 s of driving.",
        ),
    ],
)
def test_losses_and_restarts_are_those_of_the_statuses(
    ended: dict[str, float], cut: str, said: str, tmp_path: Path
) -> None:
    (tmp_path / "played.json").write_text(json.dumps({"began_s": BEGAN} | ended))
    statuses = [a_status(BEGAN + 5, 900), "{}", a_status(BEGAN + 15, 2000, pid=8)]
    (tmp_path / "statuses").write_text("\n".join([*statuses, cut]))
    assert summary(tmp_path, [DRIVE]) == said

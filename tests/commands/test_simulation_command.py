"""`roadload simulate`: effects, nuisances and roads from the command line, the truth as JSON, the log as told."""

import json
from pathlib import Path

import can
import numpy as np
import pytest
from project_paths import TOOLS

from estimator.can_io.binding import load_database
from estimator.can_io.j1939_encoder import frames_of
from estimator.commands.main import main
from estimator.signals import Role
from estimator.simulation.effects.catalogue import KINDS
from estimator.simulation.recording import simulate
from estimator.simulation.sensors import Sensors
from estimator.simulation.truck import Truck

HWFET = TOOLS / "cycles" / "hwfet.csv"
TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)


def payloads(path: Path, message: str) -> list[bytes]:
    pgn = load_database([]).get_message_by_name(message).frame_id >> 8 & 0x3FFFF
    with can.LogReader(path) as log:
        return [bytes(frame.data) for frame in log if frame.arbitration_id >> 8 & 0x3FFFF == pgn]


def test_effects_come_out_in_the_truth(tmp_path, capsys):
    path = tmp_path / "x.blf"
    arguments = ["--effect", "headwind=6", "--effect", "grade=0.012", "--effect", "resistance_segment=0.2@60-90"]
    status = main(["simulate", str(path), "--minutes", "2", "--seed", "3", "--json", *arguments])
    told = json.loads(capsys.readouterr().out)

    assert status == 0
    assert told["frames"] > 15_000
    assert [(e["name"], e["magnitude"], e["unit"]) for e in told["effects"]] == [
        ("headwind", 6.0, "m/s"),
        ("grade", 0.012, "1"),
        ("resistance_segment", 0.2, "1"),
    ]
    assert told["effects"][2]["active_s"] == [[60.0, 90.0]]
    assert told["effects"][1]["rms_kW"] > 1.0


@pytest.mark.parametrize(
    ("effect", "complaint"),
    [("grade@100-200", "acts all the time; times can be given to"), ("mass_step@60-90", "lasts to the end")],
)
def test_times_of_an_effect_that_has_none_are_refused(tmp_path, capsys, effect, complaint):
    assert main(["simulate", str(tmp_path / "x.blf"), "--minutes", "5", "--effect", effect]) == 2
    assert complaint in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_the_table_of_a_cycle_is_not_overwritten(tmp_path, capsys):
    cycle = tmp_path / "cycle.csv"
    cycle.write_text(HWFET.read_text())
    assert main(["simulate", str(cycle), "--minutes", "1", "--cycle", str(cycle)]) == 2
    assert "is an input" in capsys.readouterr().err
    assert cycle.read_text() == HWFET.read_text()


def test_nuisances_and_missing_signals_reach_the_log(tmp_path, capsys):
    path = tmp_path / "x.blf"
    arguments = ["--without", "heading", "--without", "fan_speed", "--torque-resolution", "1"]
    assert main(["simulate", str(path), "--minutes", "1", *arguments]) == 0
    capsys.readouterr()

    assert payloads(path, "FD") == []
    assert {data[:2] for data in payloads(path, "VDS")} == {b"\xff\xff"}
    assert len({data[6:8] for data in payloads(path, "VDS")}) > 1  # altitude is there
    assert {data[0] >> 4 for data in payloads(path, "EEC1")} == {0xF}  # no fraction of a per cent


def test_a_cycle_there_and_back(tmp_path, capsys):
    path = tmp_path / "x.blf"
    status = main(["simulate", str(path), "--minutes", "1", "--cycle", str(HWFET), "--shape", "out-and-back"])

    assert status == 0
    assert "hwfet.csv" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--effect", "wind"], ["did you mean headwind?"]),
        (["--effect", "xyz"], list(KINDS)),
        (["--effect", "grade=3"], ["grade", "plausible"]),
        (["--effect", "grade", "--effect", "grade"], ["twice"]),
        (["--cycle", "nowhere.csv"], ["nowhere.csv"]),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(tmp_path, capsys, arguments, words):
    path = tmp_path / "x.blf"
    status = main(["simulate", str(path), "--minutes", "1", *arguments])
    error = capsys.readouterr().err

    assert status == 2
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert all(word in error for word in words)
    assert list(tmp_path.iterdir()) == []


def test_fan_yaw_and_retarder_can_be_read_back_from_the_bus():
    rng = np.random.default_rng(3)
    recording = simulate(TRUCK, "mixed", 200.0, rng, effects={"retarder_use": None}, sensors=Sensors(jitter=0.0))
    frames = frames_of(recording.signals)
    database = load_database([])
    for message, signal, role, scale in (
        ("FD", "FanSpeed", Role.FAN_SPEED, 2 * np.pi / 60),
        ("VDC2", "YawRate", Role.YAW_RATE, 1.0),
        ("VDC2", "LateralAcceleration", Role.LATERAL_ACCELERATION, 1.0),
        ("VDC2", "LongitudinalAcceleration", Role.LONGITUDINAL_ACCELERATION, 1.0),
        ("VDS", "CompassBearing", Role.HEADING, np.pi / 180),
        ("ERC1", "ActualRetarderPercentTorque", Role.RETARDER_FRACTION, 0.01),
    ):
        layout = database.get_message_by_name(message)
        rows = frames[(frames.ident >> 8 & 0x3FFFF) == (layout.frame_id >> 8 & 0x3FFFF)]
        read = np.array([layout.decode(row.tobytes())[signal] for row in rows.data]) * scale

        step = layout.get_signal_by_name(signal).scale * scale
        np.testing.assert_allclose(read, recording.signals[role].value, atol=0.51 * step)


def test_layout_of_the_fan_drive():
    """SAE J1939-71: PGN 65213; SPN 975 byte 1, SPN 977 byte 2 bits 1-4, SPN 1639 bytes 3-4."""
    fan = load_database([]).get_message_by_name("FD")

    assert fan.frame_id >> 8 & 0x3FFFF == 65213
    assert {(s.name, s.start, s.length, s.scale) for s in fan.signals} == {
        ("EstPercentFanSpeed", 0, 8, 0.4),
        ("FanDriveState", 8, 4, 1),
        ("FanSpeed", 16, 16, 0.125),
    }


@pytest.mark.parametrize(("zone", "hours"), [("", 0.0), ("+02:00", 2.0)])
def test_a_drive_begins_when_it_is_told_to(zone: str, hours: float, tmp_path: Path) -> None:
    path = tmp_path / "x.blf"
    assert main(["simulate", str(path), "--minutes", "0.5", "--start", f"2026-03-01T06:00{zone}"]) == 0
    with can.LogReader(path) as log:
        first = next(iter(log)).timestamp
    assert first == pytest.approx(1_772_344_800.0 - 3600 * hours, abs=0.2)


@pytest.mark.parametrize(
    ("start", "said"),
    [("tomorrow", "is no date and time as in 2026-03-01T06:00"), ("0900-01-01", "is not in the years 1971 to 2099")],
)
def test_a_start_that_is_none_is_refused(
    start: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main(["simulate", str(tmp_path / "x.blf"), "--start", start])
    assert said in capsys.readouterr().err

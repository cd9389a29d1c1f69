"""What `roadload diagnose` does with poor logs, with several, and with its output: words of a reason, never a crash."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from simulated_logs import CLIMB, ask, drive, named, written

from estimator.commands.main import main
from estimator.diagnosis.case import Case
from estimator.signals import Role, Series
from estimator.simulation.effects.effect import Effect
from estimator.simulation.recording import Recording

STILL = {
    Role.SPEED: 0.0,
    Role.TORQUE_FRACTION: 0.2,
    Role.TORQUE_FRACTION_FINE: 0.0,
    Role.BRAKE_SWITCH: 0.0,
    Role.BRAKE_PEDAL: 0.0,
    Role.CLUTCH_SWITCH: 0.0,
    Role.SHIFT_IN_PROCESS: 0.0,
    Role.DRIVELINE_ENGAGED: 1.0,
    Role.GEAR: 12.0,
    Role.PARK_BRAKE: 0.0,
}
Answer = dict[str, Any]
NOTHING = ("effects", "candidates", "where", "invisible", "advice")


@pytest.fixture(scope="module")
def urban() -> Recording:
    return drive("urban", 8, 1)


@pytest.fixture
def log(tmp_path):
    def of(recording: Recording, constant: dict[Role, float] | None = None, without: tuple[Role, ...] = ()) -> Path:
        signals = {role: series for role, series in recording.signals.items() if role not in without}
        for role, value in (constant or {}).items():
            signals[role] = Series(signals[role].t, np.full(len(signals[role].t), value))
        return written(replace(recording, signals=signals), tmp_path / "poor.blf")

    return of


def cannot_tell(path: Path, *arguments: object) -> str:
    """The reason; everything that rests on a fit is empty."""
    answer = ask("diagnose", path, *arguments)
    assert answer["verdict"] == answer["remaining"]["verdict"] == "cannot tell"
    assert not any(answer[key] for key in NOTHING)
    assert answer["rms_base_kW"] is None
    assert answer["configuration"] == ""
    reason: str = answer["reason"]
    return reason


def fails(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one line of an error for which the user has to change something."""
    assert main([str(argument) for argument in arguments]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("error: ")
    assert captured.err.count("\n") == 1
    return captured.err


# Poor logs


def test_a_log_that_is_too_short(log):
    assert "less than a minute" in cannot_tell(log(drive("urban", 1, 1)))


@pytest.mark.slow
def test_a_log_that_is_nearly_long_enough(urban, log):
    assert "minutes of driving can be used; it takes 5" in cannot_tell(log(urban))


@pytest.mark.slow
def test_a_log_of_standing(urban, log):
    assert "standing" in cannot_tell(log(urban, STILL))


@pytest.mark.slow
def test_a_log_of_one_speed(urban, log):
    steady = STILL | {Role.SPEED: 20.0, Role.ENGINE_SPEED: 130.0}
    del steady[Role.TORQUE_FRACTION]  # else it would be frozen
    assert "vary too little" in cannot_tell(log(urban, steady))


@pytest.mark.slow
def test_a_log_in_which_nothing_changes(urban, log):
    reason = cannot_tell(log(urban, dict.fromkeys(urban.signals, 1.0) | STILL | {Role.SPEED: 20.0}))
    assert "speed and power frozen" in reason


@pytest.mark.slow
def test_a_log_whose_engine_never_pulls(log):
    assert "power is not positive" in cannot_tell(log(drive("highway", 11, 3), {Role.TORQUE_FRACTION: 0.0}))


@pytest.mark.slow
def test_the_reason_is_read_on_the_terminal_and_on_the_page(urban, log, tmp_path, capsys):
    path, report = log(urban), tmp_path / "report.html"
    assert main(["diagnose", str(path), "--report", str(report)]) == 0
    reason = ask("diagnose", path)["reason"]
    assert reason in capsys.readouterr().out
    assert reason in report.read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("without", "missing"),
    [
        ((Role.TORQUE_FRACTION, Role.TORQUE_FRACTION_FINE), "EEC1.ActualEngPercentTorque"),
        ((Role.SPEED, Role.BRAKE_SWITCH, Role.CLUTCH_SWITCH, Role.PARK_BRAKE), "CCVS1.WheelBasedVehicleSpeed"),
    ],
)
def test_without_power_or_speed_it_is_an_error(urban, log, capsys, without, missing):
    error = fails(capsys, "diagnose", log(urban, without=without), "--json")
    assert f"missing inputs: {missing}; start the configuration (--config FILE.toml) with signals = " in error


# Effects that are asked for


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("gravity", "; there are grade, headwind, "),
        ("", "; there are grade, headwind, "),
        ("Grade", "; did you mean grade?"),
        ("headwin", "; did you mean headwind?"),
    ],
)
def test_an_effect_that_is_not_known(urban, log, tmp_path, capsys, name, said):
    path, file = log(urban), tmp_path / "c.toml"
    file.write_text(f'effects = ["grade", "{name}"]\n')
    for arguments in (("--config", file), ("--effect", name)):
        error = fails(capsys, "diagnose", path, *arguments)
        assert f"'{name}' is not known{said}" in error


@pytest.mark.slow
def test_an_effect_that_cannot_be_given(urban, log, capsys):
    error = fails(capsys, "diagnose", log(urban), "--effect", "mass_step")
    assert "'mass_step' cannot be part of the model" in error


@pytest.mark.slow
def test_a_given_effect_without_its_signal_is_said(log):
    recording = drive("highway", 10, 3, without=[Role.ALTITUDE, Role.GRADE])
    assert "grade needs" in cannot_tell(log(recording), "--effect", "grade")


# Output


@pytest.mark.slow
def test_a_report_is_written_whole_or_not_at_all(urban, log, tmp_path, capsys):
    path, report = log(urban), tmp_path / "report.html"
    report.write_text("of yesterday")
    cut = tmp_path / "cut.blf"
    cut.write_bytes(path.read_bytes()[:-20_000])
    fails(capsys, "diagnose", path, cut, "--report", report)
    assert report.read_text() == "of yesterday"
    assert main(["diagnose", str(path), "--report", str(report)]) == 0
    assert report.read_text(encoding="utf-8").rstrip().endswith("</html>")
    assert {entry.name for entry in tmp_path.iterdir()} == {"poor.blf", "cut.blf", "report.html"}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["report.pdf", "nowhere/report.html", "poor.blf"])
def test_a_report_that_cannot_be_is_refused_before_the_work(urban, log, tmp_path, capsys, name):
    path = log(urban)
    before = path.read_bytes()
    fails(capsys, "diagnose", path, "--report", tmp_path / name)
    assert [entry.name for entry in tmp_path.iterdir()] == ["poor.blf"]
    assert path.read_bytes() == before


# Several logs of one vehicle


@pytest.fixture(scope="module")
def clean(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Answer]:
    """A drive without any effect, and what is said of it."""
    path = written(drive("mixed", 16, 43), tmp_path_factory.mktemp("clean") / "clean.blf")
    return path, ask("diagnose", path)


@pytest.mark.nightly
@pytest.mark.slow
def test_evidence_of_an_effect_adds_up_over_logs(tmp_path):
    """Bends that cost something on a road with few of them, on one with many, and a drive where they cost nothing."""
    bends = Effect(name="cornering", magnitude=550.0)
    few, many, none = (
        written(drive("mixed", 20, seed, *effects), tmp_path / f"{seed}.blf")
        for seed, effects in ((41, [bends]), (42, [bends]), (43, []))
    )

    def evidence(*logs: Path) -> float:
        answer = ask("diagnose", *logs)
        assert answer["logs"] == [str(path) for path in logs]
        return next(c["log_bayes_factor"] for c in answer["candidates"] if c["name"] == "cornering")

    alone = evidence(few), evidence(many)
    assert alone[0] < 5 < alone[1]
    assert evidence(few, many) == pytest.approx(sum(alone))
    assert evidence(many, none) < alone[1]  # it does not hold there


@pytest.mark.slow
def test_an_event_may_be_in_one_log_only(clean, tmp_path):
    wet = Effect(name="resistance_segment", magnitude=0.4, start=300.0, end=550.0)
    log = written(drive("highway", 13, 3, wet), tmp_path / "wet.blf")
    alone, beside = ask("diagnose", log), ask("diagnose", clean[0], log)
    assert named(alone) == named(beside) == ["resistance_segment"]
    for key in ("value", "sd"):
        assert beside["effects"][0]["magnitude"][key] == pytest.approx(alone["effects"][0]["magnitude"][key], rel=1e-3)
    assert beside["effects"][0]["span_s"] == alone["effects"][0]["span_s"]
    assert set(alone["effects"][0]["span_log"]) == {0}
    assert alone["parameters"]["log"] is None
    first, last = beside["parameters"]["span_s"]
    assert beside["parameters"]["log"] == 1
    assert (first, last) == (pytest.approx(0.0, abs=15.0), pytest.approx(780.0, abs=15.0))
    assert beside["effects"][0]["span_log"] == [1] * len(beside["effects"][0]["span_s"])


@pytest.mark.slow
def test_a_log_that_is_given_twice_is_no_more_evidence(urban, log, capsys):
    path = log(urban)
    error = fails(capsys, "diagnose", path, path.parent / ".." / path.parent.name / path.name)
    assert "is given twice" in error


@pytest.mark.slow
def test_logs_with_engines_of_different_torque_may_be_of_two_vehicles(urban, log, tmp_path, capsys):
    torque = urban.signals[Role.REFERENCE_TORQUE]
    other = replace(urban, signals=urban.signals | {Role.REFERENCE_TORQUE: Series(torque.t, 0.7 * torque.value)})
    assert main(["diagnose", str(log(urban)), str(written(other, tmp_path / "other.blf")), "--json"]) == 0
    captured = capsys.readouterr()
    (doubt,) = json.loads(captured.out)["doubts"]
    assert "in log 2: two vehicles?" in doubt
    assert f"note: {doubt}" in captured.err


@pytest.mark.nightly
@pytest.mark.slow
def test_hills_of_a_shorter_drive_are_hills_beside_a_longer_flat_one(tmp_path):
    flat = written(drive("highway", 26, 11), tmp_path / "flat.blf")
    hilly = written(
        drive("highway", 20, 1, Effect(name="grade", magnitude=0.01), without=CLIMB), tmp_path / "hilly.blf"
    )
    alone, both = ask("diagnose", hilly), ask("diagnose", flat, hilly)
    assert named(alone) == named(both) == ["grade"]
    expected = alone["effects"][0]["magnitude"]["value"] * np.sqrt(20 / 46)  # along both roads
    assert both["effects"][0]["magnitude"]["value"] == pytest.approx(expected, rel=0.1)


@pytest.mark.slow
def test_the_same_log_gives_the_same_bytes(clean):
    """In another process, with sets in another order, too."""
    path, answer = clean
    other = subprocess.run(
        [sys.executable, "-m", "estimator", "diagnose", str(path), "--json"],
        capture_output=True,
        check=True,
        text=True,
        env=os.environ | {"PYTHONHASHSEED": "7"},
    )
    assert json.dumps(json.loads(other.stdout)) == json.dumps(answer)  # in the same order, to the last digit
    assert len(answer["candidates"]) > 10


@pytest.mark.slow
def test_of_several_drives_one_that_cannot_be_fitted_is_left_out(clean, tmp_path, monkeypatch):
    longer, alone = clean
    shorter = written(drive("highway", 11, 3), tmp_path / "shorter.blf")
    state = Case.state

    def of_the_longer(case, is_level):
        return state(case, is_level) if case.drive.strides.t[-1] - case.drive.start > 900.0 else None

    monkeypatch.setattr(Case, "state", of_the_longer)
    both = ask("diagnose", longer, shorter)
    assert both["verdict"] == alone["verdict"]
    assert both["rms_base_kW"] == pytest.approx(alone["rms_base_kW"], rel=1e-6)
    monkeypatch.setattr(Case, "state", lambda case, is_level: None)
    assert "cannot be told apart" in cannot_tell(longer, shorter)

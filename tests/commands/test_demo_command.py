"""`roadload demo`: a drive, its log on a virtual bus, and the truth beside the estimate."""

from pathlib import Path

import can
import pytest

from estimator.commands.demo import TRUCK


@pytest.mark.slow
def test_the_truth_is_printed_and_both_logs_are_kept_in_the_working_folder(cli, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    status, printed, errors = cli("demo", "--minutes", "6", "--seed", "4")
    assert (status, errors) == (0, "")
    assert printed.startswith("drove     6 min, ")
    assert f"{TRUCK.mass:,.0f}" in printed
    assert "RoadloadMass: MassMean " in printed
    assert sorted(path.name for path in Path("out").iterdir()) == ["drive.blf", "drive_broadcast.blf"]
    with can.LogReader("out/drive_broadcast.blf") as answers:
        broadcast = sum(1 for _ in answers)
    assert f"broadcast {broadcast:,} frames" in printed


@pytest.mark.parametrize(
    ("name", "complaint"),
    [
        ("nowhere/x.blf", "there is no folder nowhere; create it first"),
        ("x.mf4", "write it as one of .blf, .asc, .log, .csv, .trc"),
    ],
)
def test_a_log_that_cannot_be_written_is_refused_before_the_drive(cli, tmp_path, monkeypatch, name, complaint):
    monkeypatch.chdir(tmp_path)
    assert cli("demo", "-o", name) == (2, "", f"error: {name}: {complaint}\n")
    assert list(tmp_path.iterdir()) == []

"""The service file: accepted by systemd, closed to the outside, and calling the program as it is."""

import re
import shutil
import subprocess

import pytest
from project_paths import ROOT

from estimator.commands.main import main
from estimator.config import load

FOLDER = ROOT / "deploy" / "systemd"
UNIT = FOLDER / "roadload.service"
NETWORK = FOLDER / "network.conf"
EXPOSURE = 2.0  # of 10, the most that is allowed


def analyze(*arguments: str) -> subprocess.CompletedProcess[str]:
    if shutil.which("systemd-analyze") is None:
        pytest.skip("no systemd-analyze here")
    done = subprocess.run(["systemd-analyze", "--no-pager", *arguments], capture_output=True, text=True)
    if "unrecognized option" in done.stderr:
        pytest.skip(f"this systemd-analyze is too old: {done.stderr.strip()}")
    return done


def test_the_service_is_closed_to_the_outside():
    done = analyze("security", "--offline=yes", f"--threshold={10 * EXPOSURE:.0f}", str(UNIT))
    exposure = re.search(r"Overall exposure level for roadload.service: ([\d.]+)", done.stdout)
    assert exposure is not None, done.stderr
    assert float(exposure[1]) <= EXPOSURE
    assert done.returncode == 0


def test_the_service_with_network_access_is_still_closed_to_others(tmp_path):
    copy = tmp_path / UNIT.name
    copy.write_text(UNIT.read_text() + NETWORK.read_text())
    done = analyze("security", "--offline=yes", f"--threshold={10 * EXPOSURE:.0f}", str(copy))
    assert done.returncode == 0, done.stdout


def test_systemd_finds_no_fault_with_the_unit(tmp_path):
    program = shutil.which("true")
    copy = tmp_path / UNIT.name
    copy.write_text(UNIT.read_text().replace("/opt/roadload/bin/roadload", str(program)))
    (tmp_path / f"{UNIT.name}.d").mkdir()
    (tmp_path / f"{UNIT.name}.d" / NETWORK.name).write_text(NETWORK.read_text())
    done = analyze("verify", "--man=no", str(copy))
    assert (done.returncode, done.stderr) == (0, "")


def test_the_unit_calls_the_program_as_it_is(capsys):
    command = re.search(r"^ExecStart=/opt/roadload/bin/roadload (.*)$", UNIT.read_text(), re.MULTILINE)
    assert command is not None
    arguments = command[1].replace("/etc/roadload/roadload.toml", str(FOLDER / "roadload.toml")).split()
    assert main([*arguments, "--print-config"]) == 0
    assert 'channel = "can0"' in capsys.readouterr().out


def test_the_example_settings_are_the_defaults_of_a_listener():
    config = load(FOLDER / "roadload.toml")
    assert not config.transmit.enabled
    assert config.reception.channel == "can0"

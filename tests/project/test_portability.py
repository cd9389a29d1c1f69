"""Logs, tables, fleets and screens need nothing that Python has on Linux alone; a daemon does, and says so."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from project_paths import ROOT, TESTS
from simulated_logs import drive, written
from without_posix import ABSENT, TRIMMED, missing_names

PROGRAM = TESTS / "support" / "without_posix.py"
VAN = ROOT / "examples" / "own_vehicle" / "van.dbc"
ON_A_BUS = ("-i", "virtual", "-c", "elsewhere")


def call(folder: Path, *arguments: str) -> tuple[int, str]:
    """Exit status and outputs of a command on a machine without POSIX."""
    command = [sys.executable, "-X", "warn_default_encoding", str(PROGRAM), *arguments]
    done = subprocess.run(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, encoding="utf-8")
    return done.returncode, done.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a drive and a database."""
    folder = tmp_path_factory.mktemp("elsewhere")
    (folder / "logs").mkdir()
    shutil.copy(VAN, folder)
    written(drive("highway", 8, 3), folder / "logs" / "drive.blf")
    return folder


def test_the_names_that_are_taken_away_are_those_of_posix_and_of_linux():
    missing = {f"{module}.{name}" for module in TRIMMED for name in missing_names(module)}
    of_posix = {
        "os.fork",
        "os.getuid",
        "os.fchmod",
        "os.statvfs",
        "os.O_NOFOLLOW",
        "signal.SIGHUP",
        "socket.CMSG_SPACE",
    }
    of_linux = {"os.sched_getaffinity", "socket.AF_CAN", "select.epoll", "time.CLOCK_BOOTTIME"}
    assert of_posix | of_linux <= missing
    assert not {"os.replace", "os.O_EXCL", "signal.SIGTERM", "socket.socket", "time.monotonic"} & missing
    assert {"fcntl", "termios", "pwd", "grp", "resource"} <= set(ABSENT)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lines", "outputs"),
    [
        (
            [
                "estimate logs/drive.blf --plot drive.png --draws draws.csv",
                "diagnose logs/drive.blf --report page.html --traces traces.csv",
                "inspect logs/drive.blf",
                "watch logs/drive.blf --speed max",
                "simulate other.asc --minutes 1",
                "check --config obd2",
                "init van.dbc -o van.toml",
            ],
            ["drive.png", "draws.csv", "page.html", "traces.csv", "other.asc", "van.toml"],
        ),
        (["fleet logs -o fleet --report"], ["fleet/drives.parquet", "fleet/fleet.html"]),
    ],
    ids=["logs", "fleet"],
)
def test_commands_need_nothing_of_linux(folder, lines, outputs):
    status, printed = call(folder, " + ".join(lines))
    assert (status, "error" in printed) == (0, False), printed
    assert all((folder / name).stat().st_size > 0 for name in outputs)


@pytest.mark.slow
def test_a_bus_or_a_daemon_is_watched(folder):
    assert call(folder, "watch", *ON_A_BUS)[0] == 0
    status, printed = call(folder, "watch", "--status", "none.json")
    assert (status, "no daemon is running: there is no file none.json" in printed) == (1, True)


@pytest.mark.slow
def test_a_daemon_is_refused_in_one_line(folder):
    remedy = "a daemon needs Linux or macOS; 'roadload watch -i INTERFACE -c CHANNEL' listens here"
    assert call(folder, "run", *ON_A_BUS) == (2, f"error: run: {remedy}\n")

"""Tests on a real SocketCAN stack. Where this kernel has none, all of them run in one boot of a virtual machine.

In the machine an ordinary pytest runs the tests that were chosen here and hands back its reports, which are then shown
as if the tests had run in place.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[2] / "tools"))

from vm.debian import VmError
from vm.machine import has_vcan, run

HERE = Path(__file__).parent
REPORTS = "ROADLOAD_TEST_REPORTS"  # where the pytest in the machine writes them
LONGEST = 600.0  # s, of the whole batch
STUCK = 150  # s, of one test
SHOWN = 40  # lines of the console, when something went wrong

in_place = cache(has_vcan)


class Reporter:
    """Writes every report as a JSON line."""

    def __init__(self, config: pytest.Config, path: Path) -> None:
        self._config, self._path = config, path

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        data = self._config.hook.pytest_report_to_serializable(config=self._config, report=report)
        with self._path.open("a") as file:
            file.write(json.dumps(data) + "\n")


class Batch:
    """The reports of the chosen tests, by node id; or why there are none."""

    def __init__(self, session: pytest.Session) -> None:
        self._config = session.config
        self.reports: dict[str, list[pytest.TestReport]] = {}
        self.missing = ("failed", "the machine gave no report of this test")
        chosen = [item.nodeid for item in session.items if HERE in item.path.parents]
        with tempfile.TemporaryDirectory() as folder:
            try:
                self._boot(chosen, Path(folder))
            except VmError as error:
                console = Path(folder) / "console.txt"
                started = console.exists()
                shown = "\n".join(console.read_text(errors="replace").splitlines()[-SHOWN:]) if started else ""
                self.missing = ("failed" if started else "skipped", f"{error}\n{shown}".strip())
            self._read(Path(folder) / "reports")

    def _boot(self, chosen: list[str], folder: Path) -> None:
        options = ["-p", "no:cacheprovider", "-p", "no:hypothesispytest", "-o", f"faulthandler_timeout={STUCK}"]
        options += ["-o", "faulthandler_exit_on_timeout=true"]
        command = [sys.executable, "-m", "pytest", *options, *chosen]
        run(command, folder, timeout=LONGEST, environment={REPORTS: str(folder / "reports")})
        console = (folder / "console.txt").read_text(errors="replace").splitlines()
        self.missing = ("failed", "\n".join([self.missing[1], *console[-SHOWN:]]))

    def _read(self, path: Path) -> None:
        for line in path.read_text().splitlines() if path.exists() else []:
            report = self._config.hook.pytest_report_from_serializable(config=self._config, data=json.loads(line))
            if isinstance(report.longrepr, list):  # JSON knows no tuples, and pytest takes a skip's reason from one
                report.longrepr = tuple(report.longrepr)
            self.reports.setdefault(report.nodeid, []).append(report)

    def of(self, item: pytest.Item) -> list[pytest.TestReport]:
        """What to show for a test."""
        if item.nodeid in self.reports:
            return self.reports[item.nodeid]
        outcome, reason = self.missing
        shown = (str(item.path), item.location[1], f"Skipped: {reason}") if outcome == "skipped" else reason
        return [pytest.TestReport(item.nodeid, item.location, {}, outcome, shown, "setup")]


BATCH = pytest.StashKey[Batch]()


def pytest_configure(config: pytest.Config) -> None:
    if REPORTS in os.environ:
        config.pluginmanager.register(Reporter(config, Path(os.environ[REPORTS])))


def pytest_runtest_protocol(item: pytest.Item) -> bool | None:
    if HERE not in item.path.parents or in_place():  # the hook is asked about every test of the session
        return None
    if BATCH not in item.config.stash:
        item.config.stash[BATCH] = Batch(item.session)
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for report in item.config.stash[BATCH].of(item):
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def ip(*arguments: str) -> None:
    """Set up interfaces, as an administrator would."""
    subprocess.run(["ip", "link", *arguments], check=True)


@pytest.fixture
def buses() -> Iterator[tuple[str, str]]:
    """Two virtual CAN interfaces that are up; a test may take them down or away."""
    names = ("vcan0", "vcan1")
    for name in names:
        ip("add", "dev", name, "type", "vcan")
        ip("set", "dev", name, "up")
    yield names
    for name in names:
        if Path("/sys/class/net", name).exists():
            ip("delete", "dev", name)

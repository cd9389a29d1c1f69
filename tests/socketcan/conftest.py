"""Tests on a real SocketCAN stack. Where this kernel has none, all of them run in one boot of a virtual machine.

Each test runs in a process of its own, with a limit of its own, here and in the machine, so that one that hangs or is
killed does not affect the others. In the machine an ordinary pytest runs the tests that were chosen here and writes
its reports, which are then shown as if the tests had run here.
"""

import faulthandler
import json
import os
import select
import signal
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path

import pytest
from _pytest.runner import runtestprotocol

sys.path.append(str(Path(__file__).parents[1] / "nightly"))

from vm.debian import VmError
from vm.machine import CONSOLE, has_vcan, run

HERE = Path(__file__).parent
GATEWAY = HERE / "gateway"  # hides what is not installed on a gateway, and is slow to import
REPORTS = "ROADLOAD_TEST_REPORTS"  # where the pytest in the machine writes them
LONGEST = 240.0  # s, of one test
LONGEST_BATCH = 1200.0  # s of this host, which may be busy, for all tests in the machine
TRACE = 5.0  # s before the end, at which the stacks of a test that hangs are printed
SHOWN = 40  # last lines of the console, shown where a report is missing

in_place = cache(has_vcan)


class Alone:
    """A test in a process of its own, which is killed with all that it started when it takes longer than LONGEST."""

    def __init__(self, item: pytest.Item, folder: Path) -> None:
        self._item = item
        self._reports, self._trace = folder / "reports", folder / "trace"

    def run(self) -> list[pytest.TestReport]:
        """The reports of the test; a failure where it wrote none."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of the threads of pytest-xdist
            child = os.fork()
        if child == 0:
            self._be_the_child()
        process = os.pidfd_open(child)
        try:
            ended, _, _ = select.select([process], [], [], LONGEST)
        finally:
            os.close(process)
            with suppress(ProcessLookupError):
                os.killpg(child, signal.SIGKILL)
            _, status = os.waitpid(child, 0)
        reports = read_reports(self._item.config, self._reports)
        if ended and status == 0:
            return reports
        reason = f"died with status {status}" if ended else f"hung for {LONGEST:g} s"
        trace = self._trace.read_text() if self._trace.exists() else ""
        return [*reports, failure(self._item, f"{reason}\n{trace}".strip())]

    def _be_the_child(self) -> None:
        status = 1
        try:
            os.setsid()
            with self._trace.open("w") as trace:
                faulthandler.dump_traceback_later(LONGEST - TRACE, file=trace)
                for report in runtestprotocol(self._item, nextitem=None, log=False):
                    write_report(self._item.config, self._reports, report)
                faulthandler.cancel_dump_traceback_later()
            status = 0
        finally:
            os._exit(status)


class Reporter:
    """Writes the reports of all tests to a file."""

    def __init__(self, config: pytest.Config, path: Path) -> None:
        self._config, self._path = config, path

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        write_report(self._config, self._path, report)


class Batch:
    """The reports of the chosen tests from the machine, by node id; or why there are none."""

    def __init__(self, session: pytest.Session) -> None:
        self.reports: dict[str, list[pytest.TestReport]] = {}
        self.missing = ("failed", "the machine gave no report of this test")
        chosen = [item.nodeid for item in session.items if HERE in item.path.parents]
        with tempfile.TemporaryDirectory() as folder:
            try:
                self._boot(chosen, Path(folder))
            except VmError as error:
                console = Path(folder) / CONSOLE
                started = console.exists()
                shown = "\n".join(console.read_text(errors="replace").splitlines()[-SHOWN:]) if started else ""
                self.missing = ("failed" if started else "skipped", f"{error}\n{shown}".strip())
            for report in read_reports(session.config, Path(folder) / "reports"):
                self.reports.setdefault(report.nodeid, []).append(report)

    def _boot(self, chosen: Iterable[str], folder: Path) -> None:
        command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:hypothesispytest", *chosen]
        environment = {REPORTS: str(folder / "reports"), "PYTHONPATH": str(GATEWAY)}
        run(command, folder, timeout=LONGEST_BATCH, environment=environment)
        console = (folder / CONSOLE).read_text(errors="replace").splitlines()
        self.missing = ("failed", "\n".join([self.missing[1], *console[-SHOWN:]]))

    def of(self, item: pytest.Item) -> list[pytest.TestReport]:
        """What to show for a test."""
        if item.nodeid in self.reports:
            return self.reports[item.nodeid]
        outcome, reason = self.missing
        if outcome == "failed":
            return [failure(item, reason)]
        skip = (str(item.path), item.location[1] or 0, f"Skipped: {reason}")
        return [pytest.TestReport(item.nodeid, item.location, {}, "skipped", skip, "setup")]


def failure(item: pytest.Item, reason: str) -> pytest.TestReport:
    """The report of a test that wrote none itself."""
    return pytest.TestReport(item.nodeid, item.location, {}, "failed", reason, "call")


def write_report(config: pytest.Config, path: Path, report: pytest.TestReport) -> None:
    """Add a report to a file, as a JSON line."""
    data = config.hook.pytest_report_to_serializable(config=config, report=report)
    with path.open("a") as file:
        file.write(json.dumps(data) + "\n")


def read_reports(config: pytest.Config, path: Path) -> list[pytest.TestReport]:
    """The reports in a file, none where there is no file."""
    reports = []
    for line in path.read_text().splitlines() if path.exists() else []:
        report = config.hook.pytest_report_from_serializable(config=config, data=json.loads(line))
        if isinstance(report.longrepr, list):  # JSON knows no tuples, and pytest takes a skip's reason from one
            report.longrepr = tuple(report.longrepr)
        reports.append(report)
    return reports


BATCH = pytest.StashKey[Batch]()


def pytest_configure(config: pytest.Config) -> None:
    if REPORTS in os.environ:
        config.pluginmanager.register(Reporter(config, Path(os.environ[REPORTS])))


def pytest_runtest_protocol(item: pytest.Item) -> bool | None:
    if HERE not in item.path.parents:  # the hook is asked about every test of the session
        return None
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for report in reports_of(item):
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def reports_of(item: pytest.Item) -> list[pytest.TestReport]:
    """Run a test, here or with all others in the machine."""
    if in_place():
        with tempfile.TemporaryDirectory() as folder:
            return Alone(item, Path(folder)).run()
    if BATCH not in item.config.stash:
        item.config.stash[BATCH] = Batch(item.session)
    return item.config.stash[BATCH].of(item)


def ip(*arguments: str) -> None:
    """Set up interfaces, as an administrator would."""
    subprocess.run(["ip", "link", *arguments], check=True)


@pytest.fixture
def buses() -> Iterator[tuple[str, str]]:
    """Two virtual CAN interfaces that are up; a test may take them down or away."""
    names = ("vcan0", "vcan1")
    delete(names)  # a test that was killed has left them
    for name in names:
        ip("add", "dev", name, "type", "vcan")
        ip("set", "dev", name, "up")
    yield names
    delete(names)


def delete(names: tuple[str, ...]) -> None:
    """Take interfaces away that are there."""
    for name in names:
        if Path("/sys/class/net", name).exists():
            ip("delete", "dev", name)

"""Fixtures and settings of all tests."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from estimator.blas_threads import one_blas_thread

OF_A_TERMINAL = ["TTY_COMPATIBLE", "TTY_INTERACTIVE", "FORCE_COLOR", "NO_COLOR", "COLUMNS", "LINES"]


def pytest_configure(config: pytest.Config) -> None:
    """Property tests with the same examples in every run, and without limits of time, which a busy machine exceeds.

    What a program prints does not depend on what the shell of the tests says of its terminal.
    """
    for name in OF_A_TERMINAL:
        os.environ.pop(name, None)
    if config.pluginmanager.hasplugin("hypothesispytest"):  # it is not installed in the machine of tests/socketcan
        from hypothesis import HealthCheck, settings

        settings.register_profile(
            "steady", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
        )
        settings.load_profile("steady")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Keep the tests of a module in one worker, for they share what fixtures compute, and those of socketcan."""
    from xdist.scheduler import LoadScopeScheduling

    class ByModule(LoadScopeScheduling):  # type: ignore[misc]  # pytest-xdist is not typed everywhere
        def _split_scope(self, nodeid: str) -> str:
            path = Path(nodeid.partition("::")[0])
            return path.parent.name if path.parent.name == "socketcan" else str(path)

    return ByModule(config, log)


@pytest.fixture(scope="session", autouse=True)
def single_threaded_blas() -> Iterator[None]:
    """One thread, as in the whole program: with more, threads of several workers wait for each other."""
    with one_blas_thread():
        yield


@pytest.fixture(scope="session")
def recordings() -> Path:
    """The folder of real recordings, which is not part of the project."""
    folder = Path(os.environ.get("ROADLOAD_DATA", "recordings"))
    if not folder.is_dir():
        pytest.skip(f"no recordings at {folder}; set ROADLOAD_DATA")
    return folder


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """A Chromium; tests with it are skipped where there is none."""
    from browser_page import running  # not in the machine of tests/socketcan

    with running() as chromium:
        yield chromium


@pytest.fixture
def without_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """`roadload fleet` estimates in this process: Dask takes two seconds to start a worker."""
    from contextlib import nullcontext

    from estimator.fleet.engine import Serial  # not in the machine of tests/socketcan

    monkeypatch.setattr("estimator.commands.fleet.dask_engine", lambda scheduler, workers: nullcontext(Serial()))


@pytest.fixture
def cli(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    """Runs a command of the program: exit status, standard output, standard error."""
    from estimator.commands.main import main  # not in the machine of tests/socketcan

    def call(*arguments: object) -> tuple[int, str, str]:
        try:
            status = main([str(argument) for argument in arguments])
        except SystemExit as end:
            status = int(end.code or 0)
        captured = capsys.readouterr()
        return status, captured.out, captured.err

    return call

"""The program holds BLAS to one thread by itself, whatever the environment allows."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.config import Config
from estimator.daemon.service.supervision import Signals, supervise
from estimator.errors import ConfigError
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.drive_extraction import diagnose_logs
from estimator.streaming.replay import estimate_logs, replay

ALLOWED = 2  # threads, by the environment


def threads() -> set[int]:
    """Threads that the BLAS libraries of this process may use."""
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


@pytest.fixture(autouse=True)
def several_threads_allowed():
    with threadpool_limits(limits=ALLOWED, user_api="blas"):
        yield


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    rng = np.random.default_rng(1)
    path = tmp_path_factory.mktemp("threads") / "drive.blf"
    truck = Truck(mass=20_000.0, A=1300.0, C=3.5)
    write_log(frames_of(record(truck, generate_route("mixed", 5e3, rng), 60.0, rng).signals), path)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("work", [estimate_logs, replay, diagnose_logs])
def test_a_log_is_worked_through_with_one_blas_thread(work, log: Path) -> None:
    seen: set[int] = set()
    work([log], Config(), lambda share: seen.update(threads()))
    assert seen == {1}
    assert threads() == {ALLOWED}


def test_the_daemon_runs_with_one_blas_thread() -> None:
    seen: set[int] = set()

    def make_plan():
        seen.update(threads())
        raise ConfigError("far enough")

    with pytest.raises(ConfigError, match="far enough"):
        supervise(make_plan, Signals())
    assert seen == {1}
    assert threads() == {ALLOWED}


@pytest.mark.slow
@pytest.mark.parametrize(("allowed", "started"), [("", "1"), ("2", "2")])
def test_a_command_starts_no_threads_unless_the_user_wants_them(allowed: str, started: str) -> None:
    program = (
        "from estimator.commands.main import main; main(['estimate', 'nowhere.asc']);"
        "from threadpoolctl import threadpool_info; print(*{library['num_threads'] for library in threadpool_info()})"
    )
    inherited = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    environment = inherited | ({"OPENBLAS_NUM_THREADS": allowed} if allowed else {})
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=environment)
    assert done.stdout.split() == [started]

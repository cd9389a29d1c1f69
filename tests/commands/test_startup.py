"""The program starts quickly because a command imports only its own needs; measured by module, not by the clock."""

import subprocess
import sys
import time
from pathlib import Path

import pytest
from daemon_bench import Bench
from msgspec.structs import replace

from estimator.daemon.service import status_file

COMPUTING = {"numpy", "scipy", "filterpy", "matplotlib", "pandas", "can", "cantools"}
OTHER_COMMANDS = {
    "estimate": {
        "matplotlib",
        "filterpy",
        "distributed",
        "scipy.fft",
        "scipy.optimize",
        "scipy.signal",
        "scipy.stats",
        "estimator.simulation",
        "estimator.diagnosis",
        "estimator.daemon",
    },
    "diagnose": {"matplotlib", "filterpy", "scipy.signal", "scipy.stats", "estimator.simulation", "estimator.daemon"},
    "simulate": {
        "matplotlib",
        "filterpy",
        "scipy.signal",
        "scipy.stats",
        "estimator.estimation",
        "estimator.diagnosis",
        "estimator.daemon",
    },
    "run": {
        "matplotlib",
        "filterpy",
        "distributed",
        "scipy.fft",
        "scipy.optimize",
        "scipy.signal",
        "scipy.stats",
        "estimator.simulation",
        "estimator.diagnosis",
        "paho",
        "grpc",
    },
}


PROGRAM = """
import atexit, sys
atexit.register(lambda: print(*sys.modules, file=sys.stderr))
from estimator.commands.main import main
sys.exit(main())
"""


def imported(*arguments: str) -> set[str]:
    """The modules that the program imports when called like this; it must succeed."""
    done = subprocess.run([sys.executable, "-c", PROGRAM, *arguments], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout
    return set(done.stderr.split())


@pytest.mark.parametrize("option", ["--version", "--help"])
def test_version_and_help_import_nothing_that_computes(option: str) -> None:
    modules = imported(option)
    assert "estimator.commands.main" in modules
    assert not COMPUTING & modules


def test_status_imports_nothing_that_computes(tmp_path: Path) -> None:
    config = tmp_path / "roadload.toml"
    config.write_text(f'[service]\nruntime_directory = "{tmp_path}"\n')
    bench = Bench(tmp_path)
    bench.turn()
    status = replace(bench.daemon.status(0.0), written_monotonic_s=time.monotonic())
    status_file.write(tmp_path / "status.json", status)
    modules = imported("status", "--json", "--config", str(config))
    assert "estimator.commands.status" in modules
    assert not COMPUTING & modules


@pytest.mark.slow
@pytest.mark.parametrize("command", OTHER_COMMANDS)
def test_a_command_imports_its_own_needs_only(command: str) -> None:
    modules = imported(command, "--help")
    assert f"estimator.commands.{command}" in modules
    assert not OTHER_COMMANDS[command] & modules


@pytest.mark.slow
def test_a_worker_of_a_fleet_imports_no_diagnosis() -> None:
    program = "import sys, estimator.fleet.run; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert not {"estimator.diagnosis", "scipy.signal", "scipy.stats", "matplotlib"} & set(done.stdout.split())

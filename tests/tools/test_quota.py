"""The share of a core that a process of the benchmarks gets."""

import subprocess
import sys
from pathlib import Path

import pytest
from full_bus.quota import Quota, nanoseconds

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc of Linux"),
]


def state(pid: int) -> str:
    """State of a process, T where it is stopped."""
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]


def test_a_process_without_a_share_stands_still_and_goes_on_afterwards() -> None:
    with subprocess.Popen([sys.executable, "-c", "while True: pass"]) as busy:
        with Quota(busy.pid, 0.0):
            while state(busy.pid) != "T":
                pass
            used = nanoseconds(busy.pid)
            assert state(busy.pid) == "T"
            assert nanoseconds(busy.pid) == used
        while nanoseconds(busy.pid) == used:
            pass
        busy.kill()


def test_the_end_of_a_process_ends_its_watch() -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as brief, Quota(brief.pid, 1.0):
        assert brief.wait() == 0
    assert brief.returncode == 0

"""Pictures and pages are the same bytes in every process: no address, hash seed, cache or clock is in them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from made_outputs import DRAWINGS, KINDS

HERE = Path(__file__).parent


def start(seed: int, home: Path) -> "subprocess.Popen[str]":
    """Draw everything in a process with a hash seed and an empty home of its own."""
    home.mkdir()
    kept = {name: value for name, value in os.environ.items() if name in ("PATH", "PYTHONPATH", "LD_LIBRARY_PATH")}
    places = dict.fromkeys(("HOME", "MPLCONFIGDIR", "XDG_CACHE_HOME"), str(home))
    return subprocess.Popen(
        [sys.executable, HERE / "support" / "made_outputs.py", home],
        env={**kept, **places, "PYTHONHASHSEED": str(seed)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.slow
def test_pictures_and_pages_do_not_depend_on_the_process(tmp_path: Path) -> None:
    running = [start(seed, tmp_path / str(seed)) for seed in (1, 2)]
    printed = []
    for process in running:
        text, complaints = process.communicate()
        assert process.returncode == 0, complaints
        printed.append(dict(line.split() for line in text.splitlines()))
    first, second = printed
    assert first == second
    assert len(first) == 5 + len(KINDS) * DRAWINGS
    for suffix in KINDS:
        assert len({value for name, value in first.items() if name.endswith(suffix)}) == 1

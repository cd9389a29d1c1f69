"""Pictures and pages are the same bytes in every process: no address, hash seed, cache or clock is in them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from made_outputs import KINDS, hashes
from project_paths import TESTS


@pytest.mark.slow
def test_pictures_and_pages_do_not_depend_on_the_process(tmp_path: Path) -> None:
    """This process, and one with another hash seed and without caches."""
    here = hashes(tmp_path)
    (home := tmp_path / "home").mkdir()
    kept = {name: value for name, value in os.environ.items() if name in ("PATH", "PYTHONPATH", "LD_LIBRARY_PATH")}
    places = dict.fromkeys(("HOME", "MPLCONFIGDIR", "XDG_CACHE_HOME"), str(home))
    command = [sys.executable, TESTS / "support" / "made_outputs.py", home]
    done = subprocess.run(
        command, env={**kept, **places, "PYTHONHASHSEED": "2"}, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert dict(line.split() for line in done.stdout.splitlines()) == here
    assert len(here) == 5 + len(KINDS)

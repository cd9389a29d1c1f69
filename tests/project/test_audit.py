"""What the audit of the dependencies says: found, clean, and not known are three things."""

import subprocess
import sys
from pathlib import Path

import pytest
from project_paths import ROOT

TOOL = ROOT / ".ci" / "audit.py"
CLEAN = '{"name": "numpy", "version": "2.4.6", "vulns": []}'
FLAWED = '{"name": "numpy", "version": "2.4.6", "vulns": [{"id": "PYSEC-1", "fix_versions": ["2.4.7"]}]}'
UNKNOWN = '{"name": "numpy", "skip_reason": "not found"}'


def audited(answer: str, tmp_path: Path) -> tuple[int, str]:
    """Exit status and output of the tool, with a stand-in for pip-audit that prints ``answer``."""
    program = tmp_path / "pip-audit"
    program.write_text(f"#!/bin/sh\ncat <<'END'\n{answer}\nEND\nexit 1\n")
    program.chmod(0o755)
    done = subprocess.run([sys.executable, str(TOOL), str(program)], capture_output=True, text=True)
    return done.returncode, done.stdout


@pytest.mark.parametrize(
    ("answer", "status", "said"),
    [
        (CLEAN, 0, "0 known vulnerabilities in 1 packages\n"),
        (FLAWED, 1, "numpy 2.4.6: PYSEC-1, mended in 2.4.7\n1 known vulnerabilities in 1 packages\n"),
        (
            f"{UNKNOWN}, {CLEAN}",
            0,
            "skipped: the database knows nothing of 1 of 2 packages\n0 known vulnerabilities in 1 packages\n",
        ),
    ],
)
def test_found_clean_and_not_known_are_told_apart(answer: str, status: int, said: str, tmp_path: Path) -> None:
    assert audited(f'{{"dependencies": [{answer}]}}', tmp_path) == (status, said)


@pytest.mark.parametrize("answer", ["", "connection refused", "{}"])
def test_without_an_answer_it_is_skipped_and_said(answer: str, tmp_path: Path) -> None:
    status, said = audited(answer, tmp_path)
    assert (status, said.partition(":")[0]) == (0, "skipped")


def test_a_program_that_is_not_there_is_skipped() -> None:
    done = subprocess.run([sys.executable, str(TOOL), "/nowhere"], capture_output=True, text=True)
    assert (done.returncode, done.stdout.partition(":")[0]) == (0, "skipped")

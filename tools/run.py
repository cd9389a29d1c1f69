#!/usr/bin/env python3
"""Set up what a task needs inside the clone, then run it: ``tools/run.py demo|types|check|test|nightly|python``.

``check`` is the fast loop, ``test`` is everything but what is ``nightly``, ``python`` runs a tool; further options are
passed on to the last step.

Needs Python >= 3.11 and nothing else. The virtual environment `.venv` is made once and renewed when the pinned
dependencies change.
"""

import hashlib
import os
import subprocess
import sys
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
ENVIRONMENT = ROOT / ".venv"
BIN = ENVIRONMENT / ("Scripts" if os.name == "nt" else "bin")
IMPORTED = [str(ROOT / folder) for folder in ("tools", "tests/nightly", "tests/support")]  # by tools
TYPES = [["mypy"], ["mypy", "tests/conftest.py"], ["mypy", "tests/socketcan/conftest.py"]]  # one conftest in each
LINT = [["ruff", "check", "."], ["ruff", "format", "--check", "."], ["lint-imports"]]
TESTS = ["pytest", "-n", "auto", "--no-loadscope-reorder"]  # a worker a core
BY_DAY = [*TESTS, "--durations", "20", "-m", "not nightly"]
TASKS = {
    "demo": ("", [["roadload", "demo"]]),
    "types": ("[dev]", TYPES),
    "check": ("[dev]", [*LINT, *TYPES, [*TESTS, "-m", "not (slow or nightly)"]]),
    "test": ("[dev]", [*LINT, BY_DAY]),
    "nightly": ("[dev]", [[*TESTS, "-m", "nightly"]]),
    "python": ("[dev]", [["python"]]),
}
BESIDE = {"test": "types"}  # which takes a minute of one processor


def program(name: str) -> str:
    """Path of a program of the environment."""
    return str(BIN / (f"{name}.exe" if os.name == "nt" else name))


def install(extras: str) -> None:
    """Install the project with ``extras`` and the pinned versions, unless that has been done."""
    pins = (ROOT / "pyproject.toml").read_bytes() + (ROOT / "constraints.txt").read_bytes()
    stamp, state = ENVIRONMENT / f"installed{extras}", hashlib.sha256(pins).hexdigest()
    if stamp.exists() and stamp.read_text(encoding="ascii") == state:
        return
    print(f"setting up {ENVIRONMENT.relative_to(ROOT)} ...", flush=True)
    if not Path(program("python")).exists():
        venv.create(ENVIRONMENT, with_pip=True)
    pip = [program("python"), "-m", "pip", "install", "-qq", "--disable-pip-version-check"]
    subprocess.run([*pip, "--constraint", "constraints.txt", "--editable", f".{extras}"], cwd=ROOT, check=True)
    stamp.write_text(state, encoding="ascii")


def main() -> int:
    """Run the task named on the command line; stops at the first step that fails."""
    if len(sys.argv) < 2 or sys.argv[1] not in TASKS:
        print(f"usage: python3 tools/run.py {'|'.join(TASKS)} [OPTION...]", file=sys.stderr)
        return 2
    task = sys.argv[1]
    extras, steps = TASKS[task]
    beside, environment = None, {**os.environ}
    if task == "python":
        environment["PYTHONPATH"] = os.pathsep.join(IMPORTED)
    try:
        install(extras)
        if task in BESIDE:
            beside = subprocess.Popen([sys.executable, __file__, BESIDE[task]])
        for step in steps:
            name, *arguments = step
            print(f"> {' '.join(step)}", flush=True)
            command = [program(name), *arguments, *(sys.argv[2:] if step is steps[-1] else [])]
            subprocess.run(command, cwd=ROOT, check=True, env=environment)
    except subprocess.CalledProcessError as error:
        return error.returncode
    finally:
        failed = beside is not None and beside.wait() != 0
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())

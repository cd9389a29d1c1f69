"""Known vulnerabilities of the pinned versions: python .ci/audit.py PIP_AUDIT (the program, of a venv of its own).

Exit status 1 if there is one. Where the database is out of reach nothing is known, which is said; that is no failure.
"""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

PINS = Path(__file__).resolve().parents[1] / "constraints.txt"
LONGEST = 300.0  # s


def main() -> int:
    """Ask pip-audit, print what it found."""
    if len(sys.argv) != 2:
        print(f"usage: {sys.argv[0]} PIP_AUDIT", file=sys.stderr)
        return 2
    command = [sys.argv[1], "-r", str(PINS), "--no-deps", "--disable-pip", "--progress-spinner", "off", "-f", "json"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LONGEST)
        lines, status = verdict(json.loads(done.stdout)["dependencies"])
    except (OSError, subprocess.TimeoutExpired, ValueError, KeyError) as error:
        lines, status = [f"skipped: pip-audit gave no answer ({type(error).__name__})"], 0
    print("\n".join(lines))
    return status


def verdict(dependencies: list[dict[str, Any]]) -> tuple[list[str], int]:
    """What to print of pip-audit's answer, and the exit status."""
    found = [
        f"{one['name']} {one['version']}: {flaw['id']}, mended in {', '.join(flaw['fix_versions']) or 'no version'}"
        for one in dependencies
        for flaw in one.get("vulns", [])
    ]
    unknown = sum("skip_reason" in one for one in dependencies)
    known = len(dependencies) - unknown
    skipped = [f"skipped: the database knows nothing of {unknown} of {known + unknown} packages"] if unknown else []
    return [*found, *skipped, f"{len(found)} known vulnerabilities in {known} packages"], int(bool(found))


if __name__ == "__main__":
    sys.exit(main())

"""Time and memory of an estimate and of a diagnosis by the length of the drive, beside plain python-can and cantools.

    python tools/bench_lengths.py [--minutes 30 75 240 480]

Seconds are those of processor time, from the start of a process to its end, and the memory is its peak: compare ratios.
The plain libraries decode the log and estimate nothing; their time is without that of their import.
The drives are of one truck with an altimeter, on mixed roads over hills, with a wind.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from bench_replay import BY_HAND, by_hand
from harness.check import Cells, Check, Figures, Table

Row = dict[str, float]
Rows = dict[str, Row]
SIMULATED = ("--effect", "headwind=5", "--effect", "grade=0.01", "--route", "mixed", "--seed", "7")
HOURLY = "[gate]\ninterval_s = 3600.0\n"
STARTER = """
import json, resource, subprocess, sys
subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps({"s": used.ru_utime + used.ru_stime, "peak MiB": used.ru_maxrss / 1024}))
"""
COMMANDS = {
    "roadload estimate, each minute": ("estimate", "--json"),
    "roadload estimate, each hour": ("estimate", "--json", "--config", "{hourly}"),
    "roadload diagnose": ("diagnose", "--json"),
}


def roadload(*arguments: str) -> list[str]:
    """Command line of the program."""
    return [sys.executable, "-m", "estimator", *arguments]


def used(command: list[str]) -> Row:
    """Seconds and peak memory of a command, started from a small process: a child's peak starts at its parent's."""
    told = subprocess.run([sys.executable, "-c", STARTER, *command], check=True, capture_output=True, text=True)
    found: Row = json.loads(told.stdout)
    return found


def decoded(path: str) -> Row:
    """Seconds that the plain libraries take to decode a log, once they are imported."""
    start = time.process_time()
    by_hand(Path(path))
    return {"s": time.process_time() - start}


def measure(options: argparse.Namespace) -> Figures:
    """Simulate drives of all lengths, and run every command on each of them."""
    figures: Figures = {}
    with tempfile.TemporaryDirectory() as folder:
        hourly = Path(folder) / "hourly.toml"
        hourly.write_text(HOURLY, encoding="utf-8")
        for minutes in options.minutes:
            log = f"{folder}/m{minutes}.blf"
            made = roadload("simulate", log, "--minutes", str(minutes), *SIMULATED)
            subprocess.run(made, check=True, capture_output=True)
            rows = {BY_HAND: decoded(log)}
            for name, (command, *flags) in COMMANDS.items():
                rows[name] = used(roadload(command, log, *(flag.format(hourly=hourly) for flag in flags)))
            figures[str(minutes)] = rows
    return figures


def tables(figures: Figures) -> list[Table]:
    """Seconds by length, those over the plain libraries', and memory: a row for each program."""
    names = next(iter(figures.values()))

    def row(name: str, value: Callable[[Rows, Row], float | None]) -> dict[str, object]:
        return {"": name} | {f"{minutes} min": value(rows, rows[name]) for minutes, rows in figures.items()}

    values: dict[str, Callable[[Rows, Row], float | None]] = {
        "seconds": lambda rows, own: own["s"],
        "seconds over those of python-can + cantools": lambda rows, own: own["s"] / rows[BY_HAND]["s"],
        "peak MiB": lambda rows, own: own.get("peak MiB"),
    }
    return [Table.of(title, [row(name, value) for name in names]) for title, value in values.items()]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the lengths of the drives."""
    parser.add_argument("--minutes", type=int, nargs="+", default=[30, 75, 240, 480])


CHECK = Check(
    title="Estimates and diagnoses by length",
    measure=measure,
    tables=tables,
    headline=Cells(rows=("roadload diagnose",), columns=("75 min", "480 min")),
    options=add_options,
)

if __name__ == "__main__":
    sys.exit(CHECK.main())

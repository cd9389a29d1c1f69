"""Processor time and memory of the commands, in the default environment and in one that limits BLAS to one thread.

    python tools/bench_commands.py [--minutes 75] [--only diagnose]

Each command runs in a process of its own, the two that read a log on a simulated drive in hills of 1 %. The two
columns of times should agree: the program itself limits BLAS to one thread. The first column is measured without
environment variables that set the number of threads.
"""

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from rich.console import Console
from rich.table import Table

THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
ROADLOAD = (sys.executable, "-m", "estimator")
DRIVE = ("--seed", "7", "--effect", "grade=0.01")
COMMANDS = {
    "version": ("--version",),
    "help": ("--help",),
    "status": ("status",),
    "estimate": ("estimate", "drive.blf", "--json"),
    "diagnose": ("diagnose", "drive.blf", "--json"),
}
NO_DAEMON = 1  # exit status of `status` where none is running


def cost(arguments: tuple[str, ...], folder: Path, environment: dict[str, str]) -> tuple[float, float]:
    """Processor time [s] and peak memory [MiB] of one run of the program, in ``folder``; stops if it failed."""
    process = subprocess.Popen(
        [*ROADLOAD, *arguments], cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in ((0, NO_DAEMON) if arguments == COMMANDS["status"] else (0,)):
        raise SystemExit(f"roadload {' '.join(arguments)}: exit status {process.returncode}")
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


def main() -> int:
    """Measure every command, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=75.0, help="length of the drive (default: 75)")
    parser.add_argument("--only", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    options = parser.parse_args()
    default = {name: value for name, value in os.environ.items() if name not in THREADS}
    single = default | dict.fromkeys(THREADS, "1")
    table = Table("command", "processor time [s]", "with one thread [s]", "peak memory [MiB]")
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        drive = [*ROADLOAD, "simulate", "drive.blf", "--minutes", str(options.minutes), *DRIVE]
        subprocess.run(drive, cwd=folder, check=True, stdout=subprocess.DEVNULL)
        for name in options.only:
            (seconds, memory), (alone, _) = (cost(COMMANDS[name], folder, e) for e in (default, single))
            table.add_row(name, f"{seconds:.2f}", f"{alone:.2f}", f"{memory:.0f}")
    Console().print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())

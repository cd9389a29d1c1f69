"""A day of traffic through the daemon's link, loop and estimator, as fast as the machine can: soak.py [--hours 24].

The traffic sets the clock, and the work of the threads runs in one loop, so that a day takes only its computing time.
Every hour is another drive of one truck, simulated in its own process; between two drives the bus is silent for a
minute. Two sizes of memory are shown: what is resident, and what the C library has given out, for which Python uses no
allocator of its own. The first also holds what was given back to the C library and not to the kernel. NumPy keeps up to
seven freed blocks of every size below 1 KiB, 3.6 MiB in all; here it has them from the start, so that they do not look
like growth. Exit status 1 if a frame was lost, or if memory grew by more than MAX_GROWTH after an hour.
"""

import argparse
import ctypes
import gc
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import full_bus.small_install  # noqa: F401  # isort: skip  (before python-can)
import numpy as np
from full_bus import traffic
from rich.console import Console
from rich.table import Table
from stepped_daemon import PlayedTraffic, link_to, turn

from estimator.can_io.frames import Frames
from estimator.checkpoint.store import StateStore
from estimator.config import Config
from estimator.daemon.service.loop import Daemon
from estimator.daemon.service.worker import Worker
from estimator.settings import Reception
from estimator.streaming.pipeline import Pipeline

HOUR, PARKED = 3600.0, 60.0  # s
PIECE = 1.0  # s of traffic per read
COLUMNS = ("t", "ident", "length", "data")
ROW = np.dtype([("t", "f8"), ("ident", "u4"), ("length", "u1"), ("data", "u1", 8)])  # of a file of frames
NOTHING = Frames.from_messages([])
EPOCH = 1_700_000_000.0  # s, wall time of the start
WIDE = 140  # columns where standard output is no terminal
MAX_GROWTH = 5.0  # MiB allocated after the first hour
CACHED_BYTES, CACHED_BLOCKS = 1024, 7  # NumPy keeps so many freed blocks of each size below the first
ENVIRONMENT = {"PYTHONMALLOC": "malloc", "OPENBLAS_NUM_THREADS": "1"}


class Day(PlayedTraffic):
    """The traffic of the day, a second at a time."""

    def __init__(self, hours: int, folder: Path) -> None:
        super().__init__(EPOCH)
        self.sent = 0  # frames
        self.hour = 0  # hours completed
        self._pieces = self._traffic(hours, folder)

    def next_piece(self) -> Frames:
        """The next second, without frames when the day is over."""
        self.now += PIECE
        return next(self._pieces, NOTHING)

    def _traffic(self, hours: int, folder: Path) -> Iterator[Frames]:
        for hour in range(hours):
            start = self.wall() - PIECE
            for piece in one_drive(hour, folder):
                self.sent += len(piece)
                yield replace(piece, t=start + piece.t)
            for _ in range(round(PARKED / PIECE)):
                yield NOTHING
            self.hour += 1


def one_drive(seed: int, folder: Path) -> Iterator[Frames]:
    """An hour of driving in pieces; simulated in another process, so that the memory measured here is the daemon's."""
    path = folder / "drive"
    command = [sys.executable, __file__, "--drive", str(seed), str(path)]
    subprocess.run(command, env=os.environ | ENVIRONMENT, check=True)
    with path.open("rb") as file:
        for count in np.fromfile(file, np.int64, round(HOUR / PIECE)).tolist():
            rows = np.fromfile(file, ROW, count)
            yield Frames(*(np.ascontiguousarray(rows[name]) for name in COLUMNS))


def write_drive(seed: int, path: Path) -> None:
    """Write the drive to a file: the number of frames of each piece, then the frames."""
    frames = traffic.drive(HOUR, seed)
    ends = np.searchsorted(frames.t, PIECE * np.arange(1, round(HOUR / PIECE) + 1))
    rows = np.empty(int(ends[-1]), ROW)
    for name in COLUMNS:
        rows[name] = getattr(frames, name)[: len(rows)]
    with path.open("wb") as file:
        np.diff(ends, prepend=0).astype(np.int64).tofile(file)
        rows.tofile(file)


def fill_cache() -> None:
    """Have NumPy keep all the small blocks that it ever keeps."""
    for size in range(1, CACHED_BYTES):
        blocks = [np.empty(size, np.uint8) for _ in range(CACHED_BLOCKS)]
        del blocks


def run(hours: int) -> None:
    """Run the day; prints one JSON object an hour."""
    fill_cache()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        day = Day(hours, folder)
        link = link_to(day, Reception())
        worker = Worker(
            Pipeline(Config(), is_live=True), Reception().queue_frames, StateStore(folder), "soak", 60.0, day.clock
        )
        files = (folder / "status.json", folder / "metrics")
        daemon = Daemon(link, None, worker, None, 5.0, *files, clock=day.clock, wall=day.wall)
        begun, reported = time.monotonic(), 0
        while reported < hours:
            turn(link, daemon, worker)
            if day.hour > reported:
                reported = day.hour
                print(json.dumps(report(day, worker) | {"seconds": time.monotonic() - begun}), flush=True)
        daemon.close()


def report(day: Day, worker: Worker) -> dict[str, Any]:
    """Counters at the end of an hour."""
    gc.collect()
    latest = worker.knowledge.estimate
    estimates = [latest.mass, latest.A, latest.C] if latest else [None] * 3
    return {
        "hour": day.hour,
        "frames": worker.pipeline.traffic.frames,
        "lost": day.sent - worker.pipeline.traffic.frames,
        "saves": worker.saves["saved"],
        "rss_MiB": resident_memory(),
        "allocated_MiB": allocated_memory(),
        "estimates": [[x.mean, x.sd] if x else None for x in estimates],
    }


def resident_memory() -> float:
    """Resident memory of this process [MiB]."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


MALLINFO = (
    *("arena", "ordblks", "smblks", "hblks", "hblkhd"),
    *("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost"),
)


class MallInfo(ctypes.Structure):
    """What mallinfo2(3) of glibc 2.33 or newer gives, over all arenas [bytes]."""

    _fields_ = tuple((name, ctypes.c_size_t) for name in MALLINFO)


def allocated_memory() -> float | None:
    """Memory that the C library has given out and not got back [MiB]; None where it does not say."""
    ask = getattr(ctypes.CDLL(None), "mallinfo2", None)
    if ask is None:
        return None
    ask.restype = MallInfo
    found = ask()
    return float(found.uordblks + found.hblkhd) / 2**20


def soak(hours: float) -> int:
    """Run the day in a process of its own, print a line for every hour, and return the exit status."""
    console, rows = Console(width=None if sys.stdout.isatty() else WIDE), []
    table = Table(
        "hour", "frames", "lost", "saves", "times real time", "RSS MiB", "allocated MiB", "mass kg", "A N", "C N s2/m2"
    )
    command = [sys.executable, __file__, "--day", str(round(hours))]
    with subprocess.Popen(command, env=os.environ | ENVIRONMENT, stdout=subprocess.PIPE, text=True) as day:
        assert day.stdout is not None
        for line in day.stdout:
            row = json.loads(line)
            rows.append(row)
            memory = [f"{row[name]:.1f}" if row[name] else "-" for name in ("rss_MiB", "allocated_MiB")]
            print(f"hour {row['hour']}: {row['frames']:,} frames, {memory[1]} MiB allocated", file=sys.stderr)
            shown = [f"{x[0]:,.4g} ± {x[1]:.2g}" if x else "-" for x in row["estimates"]]
            pace = f"{row['hour'] * (HOUR + PARKED) / row['seconds']:.0f}"
            table.add_row(
                str(row["hour"]), f"{row['frames']:,}", str(row["lost"]), str(row["saves"]), pace, *memory, *shown
            )
    console.print(table)
    truth = traffic.TRUCK
    console.print(f"truth: mass {truth.mass:,g} kg, A {truth.A:,g} N, C {truth.C:g} N s2/m2")
    allocated = [row["allocated_MiB"] for row in rows if row["allocated_MiB"] is not None]
    growth = max(allocated, default=0.0) - min(allocated[:1], default=0.0)
    console.print(f"allocated after the first hour: {growth:.1f} MiB more at most, {MAX_GROWTH:g} allowed")
    is_lossless = bool(rows) and not rows[-1]["lost"]
    return int(day.returncode != 0 or not is_lossless or growth > MAX_GROWTH)


def main() -> int:
    """Run the test, in a process of its own the day, or in another one of its drives."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hours", type=float, default=24.0, help="of traffic (default: 24)")
    parser.add_argument("--day", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--drive", nargs=2, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.day:
        run(options.day)
    elif options.drive:
        write_drive(int(options.drive[0]), Path(options.drive[1]))
    else:
        return soak(options.hours)
    return 0


if __name__ == "__main__":
    sys.exit(main())

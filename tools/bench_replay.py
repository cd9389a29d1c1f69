"""Speed of reading, decoding and replaying a long log, beside plain python-can and cantools.

    python tools/bench_replay.py [--frames 1000000]

Compare ratios: all rows are measured in one run on one machine. Peak memory is that of a fresh process.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import can
import numpy as np
from rich.console import Console
from rich.table import Table

from estimator.can_io.binding import bind, load_database
from estimator.can_io.decoder import Decoder
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.can_io.logs import open_log
from estimator.config import Config
from estimator.settings import Bus
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import draw_truck
from estimator.streaming.replay import estimate_logs, replay

FRAMES_PER_SECOND = 158.39  # of the simulated truck's bus
METRES_PER_SECOND = 33.0  # of road, more than any truck drives


def silent(share: float) -> None:
    """Progress that is not shown."""


def by_hand(path: Path) -> int:
    """The plain libraries: LogReader, a look-up by PGN, cantools decode."""
    messages = {message.key: message for message in bind(Config(), load_database([]))}
    database = load_database([])
    layouts = {key: database.get_message_by_name(message.name) for key, message in messages.items()}
    count = 0
    with can.LogReader(path) as reader:
        for frame in reader:
            count += 1
            layout = layouts.get(frame.arbitration_id >> 8 & 0x3FFFF)
            if layout is not None and layout.length <= 8:
                layout.decode(bytes(frame.data), decode_choices=False)
    return count


def read_and_decode(path: Path) -> int:
    """Our reader and decoder, no estimate."""
    decoder, count = Decoder(bind(Config(), load_database([])), Bus()), 0
    for frames in open_log(path):
        decoder.decode(frames)
        count += len(frames)
    return count


ROWS: dict[str, Callable[[Path], int]] = {
    "python-can + cantools, decode only": by_hand,
    "roadload, decode only": read_and_decode,
    "roadload estimate": lambda path: estimate_logs([path], Config(), silent).pipeline.traffic.frames,
    "roadload replay on a virtual bus": lambda path: replay([path], Config(), silent).pipeline.traffic.frames,
}


def write(path: Path, count: int) -> None:
    """A log of ``count`` frames of one long simulated drive."""
    rng = np.random.default_rng(1)
    duration = count / FRAMES_PER_SECOND
    route = generate_route("mixed", duration * METRES_PER_SECOND, rng)
    write_log(frames_of(record(draw_truck(rng), route, duration, rng).signals)[:count], path)


def measure(name: str, path: Path) -> None:
    """Run one row in this process and print its time and memory."""
    start = time.perf_counter()
    count = ROWS[name](path)
    seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"frames": count, "seconds": seconds, "peak_MiB": peak}))


def main() -> int:
    """Write the log, measure every row in a process of its own, print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--row", metavar="NAME", help=argparse.SUPPRESS)
    parser.add_argument("--log", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.log is not None:
        measure(options.row, options.log) if options.row else write(options.log, options.frames)
        return 0
    # A child's peak starts at its parent's, so the log is written in a process of its own too.
    command = [sys.executable, __file__, "--frames", str(options.frames)]
    table = Table("", "frames", "lost", "frames/s", "ratio", "peak MiB")
    with tempfile.TemporaryDirectory() as folder:
        log = ["--log", f"{folder}/long.blf"]
        subprocess.run([*command, *log], check=True)
        reference = None
        for name in ROWS:
            done = subprocess.run([*command, *log, "--row", name], check=True, capture_output=True, text=True)
            row = json.loads(done.stdout)
            rate = row["frames"] / row["seconds"]
            reference = reference or rate
            counts = [f"{row['frames']:,}", f"{options.frames - row['frames']:,}"]
            table.add_row(name, *counts, f"{rate:,.0f}", f"{rate / reference:.2f}", f"{row['peak_MiB']:.0f}")
    Console().print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main())

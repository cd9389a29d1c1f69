"""Speed of reading, decoding and replaying a long log, beside plain python-can and cantools.

    python tools/bench_replay.py [--frames 1000000]

Frames a second are those of processor time, measured in one run on one machine: compare ratios. Peak memory is that of
a fresh process.
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
from harness.check import Cells, Check, Figures, Table

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


BY_HAND = "python-can + cantools, decode only"
ROWS: dict[str, Callable[[Path], int]] = {
    BY_HAND: by_hand,
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


def run(name: str, path: Path) -> None:
    """Run one row in this process and print its time and memory."""
    start = time.process_time()
    count = ROWS[name](path)
    seconds = time.process_time() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"frames": count, "seconds": seconds, "peak_MiB": peak}))


def measure(options: argparse.Namespace) -> Figures:
    """Write the log, and measure every row in a process of its own: a child's peak starts at its parent's."""
    with tempfile.TemporaryDirectory() as folder:
        child = [sys.executable, __file__, f"{folder}/long.blf"]
        subprocess.run([*child, str(options.frames)], check=True)
        done = {name: subprocess.run([*child, name], check=True, capture_output=True, text=True) for name in ROWS}
    rows = {name: json.loads(process.stdout) for name, process in done.items()}
    return {name: {**row, "lost": options.frames - row["frames"]} for name, row in rows.items()}


def tables(figures: Figures) -> list[Table]:
    """A row for each program, with its rate beside that of the plain libraries."""
    rates = {name: row["frames"] / row["seconds"] for name, row in figures.items()}
    rows = [
        {"": name, "frames": row["frames"], "lost": row["lost"], "frames/s": rates[name]}
        | {"ratio": rates[name] / rates[BY_HAND]}
        | {"peak MiB": row["peak_MiB"]}
        for name, row in figures.items()
    ]
    return [Table.of("", rows)]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the length of the log."""
    parser.add_argument("--frames", type=int, default=1_000_000)


CHECK = Check(
    title="A long log",
    measure=measure,
    tables=tables,
    headline=Cells(columns=("ratio", "lost", "peak MiB")),
    options=add_options,
)

if __name__ == "__main__":
    if len(sys.argv) == 3 and Path(sys.argv[1]).suffix == ".blf":  # a child
        log, what = Path(sys.argv[1]), sys.argv[2]
        run(what, log) if what in ROWS else write(log, int(what))
        sys.exit()
    sys.exit(CHECK.main())

"""Frames a second of processor time of several readers of CAN logs, in one run, on the same frames.

    python tools/bench_readers.py [--minutes 10] [--only .blf .asc]

"read" yields every frame with its time, id and bytes; "decode" also the signals that the estimate needs. Where a reader
decodes whole messages, it decodes the messages that hold such a signal. Peers that are not installed are left out.
The best of the repeats counts.
"""

import argparse
import importlib.util
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import can
import numpy as np
from cantools.database import Message
from harness.check import ROOT, Cells, Check, Figures, Table

from estimator.can_io.binding import BoundMessage, bind, load_database
from estimator.can_io.decoder import Decoder
from estimator.can_io.frames import Frames
from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.logs import open_log
from estimator.config import Config
from estimator.simulation.recording import simulate
from estimator.simulation.truck import Truck

sys.path.append(str(ROOT / "tests" / "support"))
from mdf_files import Recorded, Style, mdf

LOGGER = "logger.mf4"  # unsorted and never closed, as loggers write it; the others are of python-can's writers
FORMATS = (".blf", ".asc", ".log", ".csv", ".trc", ".mf4", LOGGER)
MF4 = (".mf4", LOGGER)
DBC = ROOT / "dbc" / "j1939.dbc"
EXTENDED_PGN = 0x3FFFF00  # bits of an id that hold the PGN of a broadcast message
Reader = Callable[[Path], int]  # gives the number of frames


def roadload_read(path: Path) -> int:
    """Frames in batches, as arrays."""
    return sum(len(frames) for frames in open_log(path))


def roadload_decode(path: Path) -> int:
    """The bound signals, as arrays."""
    decoder, count = Decoder(_bound(), Config().bus), 0
    for frames in open_log(path):
        decoder.decode(frames)
        count += len(frames)
    return count


def python_can_read(path: Path) -> int:
    """A can.Message a frame."""
    return sum(1 for _ in _messages(path))


def python_can_cantools(path: Path) -> int:
    """A dictionary for each message with a bound signal."""
    wanted, count = _wanted(), 0
    for message in _messages(path):
        known = wanted.get(message.arbitration_id & EXTENDED_PGN)
        if known is not None:
            known.decode(bytes(message.data), decode_choices=False)
        count += 1
    return count


def asammdf_read(path: Path) -> int:
    """Times, ids and bytes as arrays."""
    from asammdf import MDF

    with MDF(path) as log:
        ids = log.get("CAN_DataFrame.ID")
        log.get("CAN_DataFrame.DataBytes")
        return len(ids)


def asammdf_decode(path: Path) -> int:
    """All signals of the database, as arrays."""
    from asammdf import MDF

    with MDF(path) as log:
        count = len(log.get("CAN_DataFrame.ID"))
        log.extract_bus_logging(database_files={"CAN": [(str(DBC), 0)]})
        return count


READERS: dict[str, tuple[Reader, tuple[str, ...], str]] = {  # function, formats, package
    "roadload: read": (roadload_read, FORMATS, "estimator"),
    "roadload: decode": (roadload_decode, FORMATS, "estimator"),
    "python-can: read": (python_can_read, FORMATS, "can"),
    "python-can + cantools: decode": (python_can_cantools, FORMATS, "cantools"),
    "asammdf: read": (asammdf_read, MF4, "asammdf"),
    "asammdf: decode": (asammdf_decode, MF4, "asammdf"),
}


def _messages(path: Path) -> Iterator[can.Message]:
    with can.LogReader(path) as reader:
        yield from reader


@cache
def _bound() -> list[BoundMessage]:
    """The bound signals, made once: the best of the repeats does not include reading the database."""
    return bind(Config(), load_database([]))


@cache
def _wanted() -> dict[int, Message]:
    """Messages with a bound signal, by the PGN bits of their id."""
    names = {bound.name for bound in _bound()}
    return {m.frame_id & EXTENDED_PGN: m for m in load_database([]).messages if m.name in names}


def rate(reader: Reader, path: Path, frames: int, repeats: int) -> float:
    """Frames a second of processor time [1/s], the best of the repeats; a reader that loses frames is refused."""
    best = np.inf
    for _ in range(repeats):
        began = time.process_time()
        found = reader(path)
        best = min(best, time.process_time() - began)
        if found != frames:
            raise SystemExit(f"{reader.__name__}: {path.name}: {found} frames of {frames}")
    return frames / best


def write(frames: Frames, folder: Path, formats: list[str]) -> dict[str, Path]:
    """The same frames in every format."""
    paths = {suffix: folder / (suffix if suffix == LOGGER else f"drive{suffix}") for suffix in formats}
    for suffix, path in paths.items():
        if suffix == LOGGER:
            path.write_bytes(mdf(_recorded(frames), Style(is_sorted=False, payload="values", open_flags=5)))
            continue
        with can.Logger(path) as log:
            for message in frames.messages():
                log(message)
    return paths


def _recorded(frames: Frames) -> list[Recorded]:
    return [
        Recorded(
            t=message.timestamp - float(frames.t[0]), ident=message.arbitration_id, extended=message.is_extended_id,
            data=bytes(message.data),
        )
        for message in frames.messages()
    ]  # fmt: skip


def measure(minutes: float, repeats: int, formats: list[str]) -> tuple[int, dict[str, dict[str, float]]]:
    """Number of frames, and their rate [1/s] by reader and format."""
    truck = Truck(mass=27_190.0, A=1739.0, C=3.74)
    frames = frames_of(simulate(truck, "highway", 60 * minutes, np.random.default_rng(1)).signals)
    with tempfile.TemporaryDirectory() as scratch:
        paths = write(frames, Path(scratch), formats)
        rates = {
            name: {suffix: rate(reader, paths[suffix], len(frames), repeats) for suffix in known if suffix in paths}
            for name, (reader, known, package) in READERS.items()
            if importlib.util.find_spec(package) is not None
        }
    return len(frames), rates


def figures_of(options: argparse.Namespace) -> Figures:
    """Number of frames, and rates [1/s] by reader and format."""
    frames, rates = measure(options.minutes, options.repeats, options.only)
    return {"frames": frames, "rates": rates}


def tables(figures: Figures) -> list[Table]:
    """How many times the rate of python-can, and million frames a second."""
    base = figures["rates"]["python-can: read"]
    rows = [
        [name, *(f"{found[s] / base[s]:.1f} times ({found[s] / 1e6:.2f} M/s)" if s in found else "" for s in base)]
        for name, found in figures["rates"].items()
    ]
    title = f"{figures['frames']:,} frames; frames a second of processor time beside python-can"
    return [Table(title, ("reader", *base), rows)]


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the length of the drive and the formats."""
    parser.add_argument("--minutes", type=float, default=10.0, help="length of the drive (default: 10)")
    parser.add_argument("--repeats", type=int, default=2)
    parser.add_argument("--only", nargs="+", choices=FORMATS, default=list(FORMATS))


CHECK = Check(
    title="Readers of logs",
    measure=figures_of,
    tables=tables,
    headline=Cells(rows=("roadload: decode",)),
    options=add_options,
)

if __name__ == "__main__":
    sys.exit(CHECK.main())

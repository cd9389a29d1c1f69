"""The subcommand `demo`: a simulated class-8 truck, its J1939 log replayed on a virtual bus, and the truth."""

import argparse
from pathlib import Path

import numpy as np
from rich.console import Console

from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import WRITABLE, write_log
from estimator.can_io.publisher import output_database
from estimator.commands.arguments import MINUTES, add_debug, whole_number
from estimator.commands.interruption import until_interrupted
from estimator.commands.log_options import check_outputs
from estimator.commands.tables import print_run
from estimator.commands.terminal import progress_bar, say, standard_output
from estimator.config import Config
from estimator.simulation.recording import simulate
from estimator.simulation.truck import Truck
from estimator.streaming.replay import Run, replay

TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)  # the class-8 tractor of Miller, Konan and Duran
OUTPUT = Path("out", "drive.blf")
HIDDEN = ("AliveCounter", "Checksum")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_debug(parser)
    parser.add_argument("-o", "--output", type=Path, metavar="OUT.blf", help=f"the log (default: {OUTPUT})")
    parser.add_argument("--minutes", type=MINUTES, default=45.0, help="length of the drive (default: 45)")
    parser.add_argument("--seed", type=whole_number, default=1, help="draws road and noise (default: 1)")


def run(options: argparse.Namespace) -> int:
    """Drive, write the log, replay it, and print the estimate beside the truth, and the newest frames sent."""
    log = options.output or OUTPUT
    if options.output is None:
        log.parent.mkdir(exist_ok=True)
    check_outputs([], {log: WRITABLE})
    answer = log.with_stem(f"{log.stem}_broadcast")
    console = standard_output()
    recording = simulate(TRUCK, "mixed", options.minutes * 60, np.random.default_rng(options.seed))
    frames = frames_of(recording.signals)
    write_log(frames, log)
    say(console, f"drove     {options.minutes:g} min, {len(frames):,} J1939 frames -> {log}")

    def work() -> Run:
        with progress_bar("replaying") as progress:
            return replay([log], Config(), progress, output=answer)

    result, status = until_interrupted(work)
    print_run(console, result, {"mass": TRUCK.mass, "A": TRUCK.A, "C": TRUCK.C})
    _print_last_broadcast(console, result)
    if not status:
        say(console, f"recorded  {answer}, which the shipped roadload.dbc decodes; the drive: roadload inspect {log}")
    return status


def _print_last_broadcast(console: Console, result: Run) -> None:
    """The newest frame of every message that went out, decoded with the shipped output DBC."""
    newest = {message.arbitration_id: message for message in result.broadcast}
    database = output_database()
    for ident, message in sorted(newest.items()):
        layout = database.get_message_by_frame_id(ident)
        signals = layout.decode_simple(bytes(message.data))
        values = {n: f"{v:g}" if isinstance(v, float) else v for n, v in signals.items() if n not in HIDDEN}
        shown = ", ".join(f"{name} {value}" for name, value in values.items())
        say(console, f"  {ident:08X}  {bytes(message.data).hex(' ').upper()}  {layout.name}: {shown}")

"""Demonstration: simulate a class-8 truck, replay its J1939 log on a virtual bus, compare with the truth."""

import argparse
import sys
from pathlib import Path

import numpy as np
from rich.console import Console

from estimator.can_io.j1939_encoder import frames_of
from estimator.can_io.log_writer import write_log
from estimator.can_io.publisher import output_database
from estimator.commands.tables import print_run
from estimator.commands.terminal import say
from estimator.config import Config
from estimator.errors import RoadloadError
from estimator.simulation.recording import record
from estimator.simulation.route import generate_route
from estimator.simulation.truck import Truck
from estimator.streaming.replay import Run, replay

TRUCK = Truck(mass=27_190.0, A=1739.0, C=3.74)  # the class-8 tractor of Miller, Konan and Duran
HIDDEN = ("AliveCounter", "Checksum")
METRES_PER_MINUTE = 2000.0


def main() -> int:
    """Print estimate, interval and truth, and the frames sent on the bus."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=45.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--folder", type=Path, default=Path("out"))
    options = parser.parse_args()
    console = Console()
    options.folder.mkdir(parents=True, exist_ok=True)
    log, answer = options.folder / "drive.blf", options.folder / "broadcast.blf"

    rng = np.random.default_rng(options.seed)
    route = generate_route("mixed", options.minutes * METRES_PER_MINUTE, rng)
    frames = frames_of(record(TRUCK, route, options.minutes * 60, rng).signals)
    write_log(frames, log)
    say(console, f"drove     {options.minutes:g} min, {len(frames):,} J1939 frames -> {log}")
    try:
        run = replay([log], Config(), lambda share: None, output=answer)
    except RoadloadError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_status
    print_run(console, run, {"mass": TRUCK.mass, "A": TRUCK.A, "C": TRUCK.C})
    show_last_broadcast(console, run)
    say(console, f"recorded  {answer}, which dbc/roadload.dbc decodes; the drive: .venv/bin/roadload inspect {log}")
    return 0


def show_last_broadcast(console: Console, run: Run) -> None:
    """Print the newest frame of every message that went out, decoded with the shipped output DBC."""
    newest = {message.arbitration_id: message for message in run.broadcast}
    database = output_database()
    for ident, message in sorted(newest.items()):
        layout = database.get_message_by_frame_id(ident)
        signals = layout.decode_simple(bytes(message.data))
        values = {n: f"{v:g}" if isinstance(v, float) else v for n, v in signals.items() if n not in HIDDEN}
        shown = ", ".join(f"{name} {value}" for name, value in values.items())
        say(console, f"  {ident:08X}  {bytes(message.data).hex(' ').upper()}  {layout.name}: {shown}")


if __name__ == "__main__":
    sys.exit(main())

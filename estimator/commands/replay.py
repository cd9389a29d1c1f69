"""The subcommand `replay`: logs on a virtual bus, through the daemon's loop."""

import argparse
from pathlib import Path

from estimator.can_io.log_writer import WRITABLE
from estimator.commands.arguments import add_output, add_settings
from estimator.commands.complaints import complain
from estimator.commands.interruption import until_interrupted
from estimator.commands.log_options import (
    RECORDED,
    add_channels,
    add_seed,
    check_outputs,
    complain_of_channels,
    complain_of_databases,
    settings,
    speed_of,
)
from estimator.commands.tables import print_run
from estimator.commands.terminal import print_json, progress_bar, standard_output
from estimator.report import summary
from estimator.streaming import replay
from estimator.streaming.replay import Run


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_output(parser)
    add_settings(parser)
    parser.add_argument("log", nargs="+", type=Path, metavar="LOG", help=RECORDED)
    parser.add_argument("--speed", default="max", metavar="max|FACTOR", help="multiple of real time (default: max)")
    parser.add_argument(
        "--output", type=Path, metavar="OUT.blf", help=f"record what was broadcast: {' '.join(WRITABLE)}"
    )
    add_channels(parser)
    add_seed(parser, "sampler")


def run(options: argparse.Namespace) -> int:
    """Replay, and print the answer."""
    check_outputs(options.log, {options.output: WRITABLE})
    speed = speed_of(options.speed)
    chosen = settings(options)

    def work() -> Run:
        with progress_bar("replaying") as progress:
            return replay.replay(options.log, chosen, progress, speed, options.output)

    result, status = until_interrupted(work)
    if status and options.output is not None:
        complain(f"note: {options.output}: not written")
    complain_of_channels(result.mixed_channels)
    complain_of_databases(settings(options))
    if options.json:
        print_json(summary.of_run(result))
    else:
        print_run(standard_output(), result)
    return status

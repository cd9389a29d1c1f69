"""The subcommand `replay`: logs on a virtual bus, through the daemon's loop."""

import argparse
from pathlib import Path

from estimator.can_io.log_writer import WRITABLE
from estimator.commands.arguments import add_output, add_settings, positive
from estimator.commands.log_options import (
    RECORDED,
    add_channels,
    add_seed,
    check_outputs,
    complain_of_channels,
    complain_of_databases,
    settings,
)
from estimator.commands.tables import print_run
from estimator.commands.terminal import print_json, progress_bar, standard_output
from estimator.errors import ConfigError
from estimator.report import summary
from estimator.streaming import replay


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
    """Replay, and print the answer.

    Raises
    ------
    ConfigError
        ``--speed`` is neither "max" nor a positive factor.
    """
    check_outputs(options.log, {options.output: WRITABLE})
    speed = None
    if options.speed != "max":
        try:
            speed = positive(options.speed)
        except argparse.ArgumentTypeError as error:
            raise ConfigError(f"--speed: {options.speed!r} is neither 'max' nor a positive factor") from error
    with progress_bar("replaying") as progress:
        result = replay.replay(options.log, settings(options), progress, speed, options.output)
    complain_of_channels(result.mixed_channels)
    complain_of_databases(settings(options))
    if options.json:
        print_json(summary.of_run(result))
    else:
        print_run(standard_output(), result)
    return 0

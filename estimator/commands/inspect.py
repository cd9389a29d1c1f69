"""The subcommand `inspect`: the inputs that a log carries."""

import argparse
from pathlib import Path

from estimator.commands.arguments import add_output, add_settings
from estimator.commands.log_options import (
    RECORDED,
    add_channels,
    add_map,
    complain_of_channels,
    complain_of_databases,
    settings,
)
from estimator.commands.tables import print_inspection
from estimator.commands.terminal import print_json, progress_bar, standard_output
from estimator.streaming import inspection


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_output(parser)
    add_settings(parser)
    parser.add_argument("log", type=Path, metavar="LOG", help=RECORDED)
    add_channels(parser)
    add_map(parser)


def run(options: argparse.Namespace) -> int:
    """Inspect, and print the inputs."""
    with progress_bar("reading") as progress:
        answer = inspection.inspect(options.log, settings(options), progress)
    complain_of_channels(answer.frames.mixed_channels)
    complain_of_databases(settings(options))
    if options.json:
        print_json(answer)
    else:
        print_inspection(standard_output(), answer)
    return 0

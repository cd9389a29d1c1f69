"""The subcommand `status`: the state of a running daemon, from its status file.

Other programs call it every few seconds, so it imports no numerical package.
"""

import argparse
from pathlib import Path

import msgspec

from estimator import config
from estimator.answers.status import NotRunningAnswer
from estimator.commands.arguments import add_output
from estimator.commands.complaints import complain
from estimator.commands.status_table import print_status
from estimator.commands.terminal import print_json, standard_output
from estimator.daemon.service import folders, status_file


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_output(parser)
    parser.add_argument("--config", type=Path, metavar="FILE.toml", help="the daemon's configuration")


def run(options: argparse.Namespace) -> int:
    """Print the status; exit status 1 if no daemon is running.

    Raises
    ------
    InputError
        The status file cannot be read, or is none.
    """
    places = folders.status_places(config.load(options.config).service)
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        hint = "" if options.config else "; give --config FILE.toml if the daemon has service.runtime_directory"
        missing = f"there is no {' nor '.join(map(str, places))}{hint}"
        if options.json:
            print_json(NotRunningAnswer(why_not=missing))
        else:
            complain(f"no daemon is running: {missing}")
        return 1
    status = status_file.read(path)
    reason = status_file.obstacle_to_status(status)
    if options.json:
        print_json(msgspec.structs.replace(status, running=not reason, why_not=reason))
    elif reason:
        complain(f"no daemon is running: {path}: {reason}")
    else:
        print_status(standard_output(), status)
    return 1 if reason else 0

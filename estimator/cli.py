"""The `roadload` command: what all subcommands share; and how a run ends."""

import argparse
import logging
import sys
from pathlib import Path
from typing import NoReturn

from estimator import __version__, cli_daemon
from estimator.errors import RoadloadError


def main(arguments: list[str] | None = None) -> int:
    """Run one subcommand; returns the exit status: 0, 2 for bad input, 1 for a run that could not finish."""
    options = _parser(sys.argv[1:] if arguments is None else arguments).parse_args(arguments)
    # python-can logs what it cannot parse; the log readers raise or count it themselves.
    logging.getLogger("can").setLevel(logging.CRITICAL)
    try:
        status: int = options.run(options)
        sys.stdout.flush()
    except RoadloadError as error:
        if options.debug:
            raise
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        return error.exit_status
    except BrokenPipeError:
        # Whoever read our output has gone; keep the interpreter from complaining about it at exit.
        sys.stderr.close()
        return 1
    except OSError as error:
        if options.debug:
            raise
        print(f"error: {error.filename or 'output'}: {error.strerror}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("error: interrupted", file=sys.stderr)
        return 1
    return status


class Parser(argparse.ArgumentParser):
    """Argument parser whose complaints are one line too."""

    def error(self, message: str) -> NoReturn:
        """Say what is wrong with the command line and where to read on; exit status 2."""
        print(f"error: {message}; see {self.prog} --help", file=sys.stderr)
        raise SystemExit(2)


def _parser(arguments: list[str]) -> argparse.ArgumentParser:
    parser = Parser(prog="roadload", description="Vehicle mass, rolling resistance and drag from CAN.")
    parser.add_argument("--version", action="version", version=f"roadload {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")

    shown = Parser(add_help=False)
    shown.add_argument("--json", action="store_true", help="one JSON object on standard output")
    shown.add_argument("--debug", action="store_true", help="show a traceback on errors")
    common = Parser(add_help=False, parents=[shown])
    common.add_argument("--config", type=Path, metavar="FILE.toml", help="settings and signal binding")
    common.add_argument("--dbc", action="append", metavar="FILE.dbc", help="instead of the configuration's databases")

    # A daemon runs for years on a small machine: what it does not need is not even loaded.
    if arguments[:1] not in [[name] for name in cli_daemon.COMMANDS]:
        from estimator import cli_logs, cli_simulation

        cli_logs.add_commands(commands, common)
        cli_simulation.add_commands(commands, shown)
    cli_daemon.add_commands(commands, common, shown)
    return parser

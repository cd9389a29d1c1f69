"""The `roadload` command: what all subcommands share; and how a run ends."""

import argparse
import io
import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NoReturn

from estimator import __version__
from estimator.blas_threads import start_no_blas_threads
from estimator.commands.complaints import complain, show_traceback
from estimator.errors import RoadloadError
from estimator.freed_memory import keep_freed_memory
from estimator.lean_import import import_lean
from estimator.near_names import did_you_mean

COMMANDS = {  # module of this package, and its use
    "demo": "drive a simulated truck, replay its log, compare with the truth",
    "replay": "play logs on a virtual bus to the daemon's loop",
    "estimate": "the same answer from logs without a bus",
    "fleet": "many logs to a table of drives and one of vehicles",
    "diagnose": "where the model is wrong, why, and by how much",
    "inspect": "what is in a log",
    "simulate": "drive a simulated truck and write a log",
    "run": "estimate on a live bus until stopped",
    "init": "propose a configuration from a DBC, and a log",
    "check": "dry run: can this log or bus feed the estimate?",
    "status": "status of a running daemon",
    "watch": "a log, a bus or a running daemon on a screen that lives",
}


def main(arguments: list[str] | None = None) -> int:
    """Run one subcommand; returns the exit status: 0, 2 for bad input, 1 for a run that could not finish."""
    keep_freed_memory()
    start_no_blas_threads()
    _prepare_output()
    arguments = sys.argv[1:] if arguments is None else arguments
    is_debugged = "--debug" in arguments
    try:
        options = _parsed(arguments)
        # python-can logs frames that it cannot parse; the log readers raise or count them.
        logging.getLogger("can").setLevel(logging.CRITICAL)
        with _terminated_as_interrupted():
            status: int = options.run(options)
        sys.stdout.flush()
    except RoadloadError as error:
        show_traceback() if is_debugged else complain(f"error: {error}")
        return error.exit_status
    except BrokenPipeError:
        # The reader of the output has closed it; without this the interpreter reports an error at exit.
        sys.stderr.close()
        return 1
    except OSError as error:
        if is_debugged:
            show_traceback()
        complain(f"error: {error.filename or 'output'}: {error.strerror}")
        return 1
    except KeyboardInterrupt:
        complain("error: interrupted")
        return 1
    return status


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """SIGTERM ends the work as SIGINT does, so that no file is left half written."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _prepare_output() -> None:
    """Where an output is closed, write to none; letters that its encoding lacks become question marks."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115  # until the process ends
        if isinstance(stream := getattr(sys, name), io.TextIOWrapper):
            stream.reconfigure(errors="replace")


class Parser(argparse.ArgumentParser):
    """Argument parser whose complaints are one line too."""

    def error(self, message: str) -> NoReturn:
        """Print what is wrong with the command line, and the command for help; exit status 2."""
        if wrong := re.search(r"invalid choice: '(.*?)' \(choose from (.*)\)", message):
            choices = [choice.strip("' ") for choice in wrong[2].split(",")]
            message += did_you_mean(wrong[1], choices)
        complain(f"error: {message}; see {self.prog} --help")
        raise SystemExit(2)

    def refuse(self, unknown: list[str]) -> NoReturn:
        """Print which arguments are ``unknown``, and what the first may stand for; exit status 2."""
        option = unknown[0].partition("=")[0]
        guess = did_you_mean(option, self._option_string_actions, beyond="--") if option.startswith("--") else ""
        self.error(f"unrecognized arguments: {' '.join(unknown)}{guess}")


def _parsed(arguments: list[str]) -> argparse.Namespace:
    """The options of ``arguments``; only the module of the subcommand among them is imported."""
    parser = Parser(prog="roadload", description="Vehicle mass, rolling resistance and drag from CAN.")
    parser.add_argument("--version", action="version", version=f"roadload {__version__}")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    name = next((word for word in arguments if not word.startswith("-")), None)
    chosen = parser
    for each, use in COMMANDS.items():
        command = subparsers.add_parser(each, help=use)
        if each == name:
            chosen = command
            module = import_lean(f"estimator.commands.{name}", without=["asammdf"], lazy=["numpy.f2py"])
            module.add_arguments(command)
            command.set_defaults(run=module.run)
    options, unknown = parser.parse_known_args(arguments)
    if unknown:
        chosen.refuse(unknown)
    return options

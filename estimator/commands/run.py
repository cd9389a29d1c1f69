"""The subcommand `run`: the daemon on a live bus."""

import argparse
import logging
import signal

import can.cli

from estimator.commands.arguments import add_debug, add_print_config, add_settings
from estimator.commands.terminal import print_config
from estimator.daemon.service import logging_setup
from estimator.daemon.service.assembly import plan, settle
from estimator.daemon.service.supervision import Signals, supervise
from estimator.errors import ConfigError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_debug(parser)
    add_settings(parser)
    can.cli.add_bus_arguments(parser, group_title="bus")
    can.cli.add_bus_arguments(parser, prefix="output", group_title="bus to send on, where it is another")
    parser.add_argument("--transmit", action="store_true", help="broadcast the estimate (default: listen only)")
    add_print_config(parser)
    parser.add_argument("--verbose", action="store_true", help="log more")


def run(options: argparse.Namespace) -> int:
    """Run until SIGTERM or SIGINT.

    Raises
    ------
    ConfigError
        On Windows, which has neither the signals nor the locks of a daemon.
    """
    if options.print_config:
        print_config(settle(options.config, options.dbc, options))
        return 0
    if not hasattr(signal, "SIGHUP"):
        raise ConfigError("run: a daemon needs Linux or macOS; 'roadload watch -i INTERFACE -c CHANNEL' listens here")
    level = logging.DEBUG if options.verbose else logging.INFO
    with logging_setup.on_standard_error(level), Signals().caught() as signals:
        supervise(lambda: plan(options.config, options.dbc, options), signals)
    return 0

"""The subcommand `check`: whether a log or a bus can feed the estimate."""

import argparse
import time
from collections import Counter
from pathlib import Path

import can
import can.cli
import msgspec

from estimator import config
from estimator.answers.inspection import InspectionAnswer
from estimator.can_io.binding import load_database
from estimator.can_io.bound_traffic import bound_messages
from estimator.can_io.frames import Frames
from estimator.commands.arguments import add_output, add_print_config, add_settings, number
from estimator.commands.log_options import add_map, complain_of_channels, complain_of_databases, table_of
from estimator.commands.tables import print_binding, print_inspection
from estimator.commands.terminal import print_config, print_json, say, standard_output
from estimator.config import Config
from estimator.daemon.reception.buses import BusSpec, NotThereError, open_bus, spec_of
from estimator.daemon.reception.message_clock import MessageClock
from estimator.daemon.reception.reader import reader_of
from estimator.daemon.reception.uptime import since_start
from estimator.daemon.service.assembly import settle
from estimator.model.effects import named
from estimator.report.binding import of_binding
from estimator.streaming import inspection
from estimator.streaming.missing_inputs import unbound

SECONDS = number(1.0, 86_400.0, "a number of seconds from 1 to 86400")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_output(parser)
    add_settings(parser)
    parser.add_argument(
        "log",
        nargs="?",
        type=Path,
        metavar="LOG",
        help="a log; without one, the bus is read if options, configuration or can.conf name one",
    )
    parser.add_argument("--no-bus", action="store_true", help="read none: check configuration and databases alone")
    add_map(parser)
    can.cli.add_bus_arguments(parser, group_title="bus")
    parser.add_argument("--seconds", type=SECONDS, default=10.0, help="how long to read the bus (default: 10)")
    add_print_config(parser)


def run(options: argparse.Namespace) -> int:
    """Inspect the log or the bus, or the configuration alone; exit status 0 if an estimate can come of it."""
    settings = settle(options.config, options.dbc, options)
    settings = config.replace(settings, table=table_of(settings.table, options.map))
    with config.in_file(options.config):
        messages = bound_messages(settings)
        named(settings.effects)
    if options.print_config:
        print_config(settings)
        return 0
    complain_of_databases(settings)
    spec = spec_of(options, settings.reception)
    if options.log is None and (options.no_bus or not spec.is_named):
        bound = {signal.role for message in messages for signal in message.signals}
        reason = unbound(settings, bound)
        binding = of_binding(settings, messages, load_database(settings.bus.dbc).remarks, reason)
        print_json(binding) if options.json else print_binding(standard_output(), binding)
        return 1 if reason else 0
    if options.log is not None:
        chosen = getattr(options, "channel", None)
        channels = settings.bus.channels if chosen is None else [chosen]
        read = config.replace(settings, bus=msgspec.structs.replace(settings.bus, channels=channels))
        answer = inspection.inspect(options.log, read, lambda share: None)
        complain_of_channels(answer.frames.mixed_channels)
    else:
        answer = _hear(spec, settings, options.seconds)
    if options.json:
        print_json(answer)
    else:
        console = standard_output()
        print_inspection(console, answer)
        for message, senders in answer.senders.items():
            if len(senders) > 1:
                say(console, f"several nodes send {message}: {', '.join(f'0x{a:02X}' for a in senders)}")
        say(console, "the model can be fed" if answer.usable else "the model cannot be fed")
    return 0 if answer.usable else 1


def _hear(spec: BusSpec, settings: Config, seconds: float) -> InspectionAnswer:
    """Inspection of all traffic on a bus for some seconds."""
    try:
        bus = open_bus(spec, None)
    except NotThereError as error:
        raise NotThereError(f"{spec.label}: {error}") from error
    found, skipped = inspection.Inspection(settings), Counter[str]()
    clock = MessageClock(time.time() - since_start())
    try:
        reader = reader_of(bus, settings.reception.buffer_bytes)
        end = since_start() + seconds
        while (left := end - since_start()) > 0:
            batch = reader.read(min(left, 0.2))
            frames = batch.frames
            t = clock.correct(frames.t, since_start())
            found.add(Frames(t, frames.ident, frames.length, frames.data))
            skipped["error frame"] += batch.errors
            skipped["remote frame"] += batch.remote
        skipped["lost in the kernel"] = reader.kernel_drops()
    except (OSError, can.CanError) as error:
        raise NotThereError(f"{spec.label}: {error}") from error
    finally:
        bus.shutdown()
    return found.report(spec.label, +skipped)

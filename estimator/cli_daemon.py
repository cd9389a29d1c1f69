"""The subcommands of the daemon: `run`, `check` and `status`."""

import argparse
import json
import logging
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import can.cli
import msgspec
from rich.console import Console
from rich.text import Text

from estimator import config, inspection, toml_text
from estimator.can_io.frames import Frames
from estimator.cli_tables import print_inspection, say
from estimator.config import Config
from estimator.daemon import folders, journal, status
from estimator.daemon.assembly import Plan, plan, settle
from estimator.daemon.buses import BusSpec, NotThereError, open_bus, spec_of
from estimator.daemon.message_clock import MessageClock
from estimator.daemon.reader import reader_of
from estimator.daemon.status import State
from estimator.daemon.supervision import Signals, supervise
from estimator.errors import InputError

COMMANDS = ("run", "check", "status")
WIDE = 140  # columns where standard output is no terminal
COLOURS = {
    State.WAITING: "yellow",
    State.LISTENING: "yellow",
    State.SILENT: "yellow",
    State.RECEIVING: "green",
    State.FAULT: "red",
}


def add_commands(commands: Any, common: argparse.ArgumentParser, shown: argparse.ArgumentParser) -> None:
    """Add the subcommands; ``common`` has --config, --dbc, --json and --debug, ``shown`` the last two."""
    running = commands.add_parser("run", parents=[common], help="estimate on a live bus until told to stop")
    can.cli.add_bus_arguments(running, group_title="bus")
    can.cli.add_bus_arguments(running, prefix="output", group_title="bus to send on, where it is another")
    running.add_argument("--transmit", action="store_true", help="broadcast the estimate (default: listen only)")
    running.add_argument("--print-config", action="store_true", help="print the settings in force as TOML, and stop")
    running.add_argument("--verbose", action="store_true", help="log more")
    running.set_defaults(run=_run)

    checked = commands.add_parser("check", parents=[common], help="dry run: can this log or bus feed the estimate?")
    checked.add_argument("log", nargs="?", type=Path, metavar="LOG", help="a log; without one, the bus is heard")
    can.cli.add_bus_arguments(checked, group_title="bus")
    checked.add_argument("--seconds", type=_seconds, default=10.0, help="how long to hear the bus (default: 10)")
    checked.add_argument("--print-config", action="store_true", help="print the settings in force as TOML, and stop")
    checked.set_defaults(run=_check)

    asked = commands.add_parser("status", parents=[shown], help="what a running daemon knows")
    asked.add_argument("--config", type=Path, metavar="FILE.toml", help="the daemon's configuration")
    asked.set_defaults(run=_status)


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 1.0 <= value <= 86_400.0:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of seconds from 1 to 86400")
    return value


def _run(options: argparse.Namespace) -> int:
    if options.print_config:
        _print_config(settle(options.config, options.dbc, options))
        return 0
    level = logging.DEBUG if options.verbose else logging.INFO
    with journal.on_standard_error(level), Signals().caught() as signals:
        supervise(lambda: _plan(options), signals)
    return 0


def _plan(options: argparse.Namespace) -> Plan:
    return plan(options.config, options.dbc, options)


def _print_config(settings: Config) -> None:
    tables = msgspec.to_builtins(settings)
    tables["signals"] = {str(role): bound for role, bound in settings.binding.items()}
    print(toml_text.dump(tables), end="")


def _check(options: argparse.Namespace) -> int:
    settings = settle(options.config, options.dbc, options)
    if options.print_config:
        _print_config(settings)
        return 0
    if options.log is not None:
        content = inspection.inspect(options.log, settings, lambda share: None)
    else:
        content = _hear(spec_of(options, settings.reception), settings, options.seconds)
    if options.json:
        print(json.dumps(content, indent=2, allow_nan=False))
    else:
        console = Console() if sys.stdout.isatty() else Console(width=WIDE)
        print_inspection(console, content)
        for message, senders in content["senders"].items():
            if len(senders) > 1:
                say(console, f"several nodes send {message}: {', '.join(f'0x{a:02X}' for a in senders)}")
        say(console, "the model can be fed" if content["usable"] else "the model cannot be fed")
    return 0 if content["usable"] else 1


def _hear(spec: BusSpec, settings: Config, seconds: float) -> dict[str, Any]:
    """Inspect a bus for some seconds, all of its traffic."""
    try:
        bus = open_bus(spec, None)
    except NotThereError as error:
        raise NotThereError(f"{spec.label}: {error}") from error
    found, skipped = inspection.Inspection(settings), Counter[str]()
    clock = MessageClock(time.time() - time.monotonic())
    try:
        reader = reader_of(bus, settings.reception.buffer_bytes)
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            batch = reader.read(min(left, 0.2))
            frames = batch.frames
            t = clock.correct(frames.t, time.monotonic())
            found.add(Frames(t, frames.ident, frames.length, frames.data))
            skipped["error frame"] += batch.errors
            skipped["remote frame"] += batch.remote
        skipped["lost in the kernel"] = reader.kernel_drops()
    except (OSError, can.CanError) as error:
        raise NotThereError(f"{spec.label}: {error}") from error
    finally:
        bus.shutdown()
    return found.report(spec.label, +skipped)


def _status(options: argparse.Namespace) -> int:
    service = config.load(options.config).service
    places = folders.status_places(service)
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        print(f"no daemon is running: there is no {' nor '.join(map(str, places))}", file=sys.stderr)
        return 1
    try:
        content = json.loads(path.read_bytes())
        reason = status.verdict(content)
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}") from error
    except (ValueError, AttributeError):
        raise InputError(f"{path}: is not a status file; delete it") from None
    if options.json:
        print(json.dumps({"running": not reason, "why_not": reason, **content}, indent=2, allow_nan=False))
    elif reason:
        print(f"no daemon is running: {path}: {reason}", file=sys.stderr)
    else:
        _print_status(Console() if sys.stdout.isatty() else Console(width=WIDE), content)
    return 1 if reason else 0


def _print_status(console: Console, content: dict[str, Any]) -> None:
    """A screenful for people."""
    detail = f": {content['detail']}" if content["detail"] else ""
    colour = COLOURS[State(content["state"])]
    console.print(Text.assemble((content["state"], f"bold {colour}"), detail), soft_wrap=True)
    for name in ("input", "output"):
        link = content[name]
        if link is None:
            continue
        rate = f", {content['frames_per_s'] or 0:,.0f} per s" if name == "input" else ""
        say(console, f"{name:9} {link['bus']}: {link['frames']:,} frames{rate}; re-opened {link['reopened']} times")
        losses = {"kernel": link["kernel_drops"], "queue": link["queue_drops"]}
        lost = ", ".join(f"{n:,} in the {place}" for place, n in losses.items() if n) or "none"
        say(console, f"lost      {lost}; error frames {link['errors']:,}; clock steps {content['clock_steps']}")
    for role, signal in content["signals"].items():
        age = "none valid since the start" if signal["age_s"] is None else f"newest valid {signal['age_s']:.1f} s ago"
        say(console, f"  {role:24} {signal['readings']:>10,} readings, {age}")
    if content["missing"]:
        say(console, f"missing   {', '.join(content['missing'])}")
    for reason, count in sorted(content["refused"].items()):
        say(console, f"refused   {reason} {count:,}")
    estimate = content["estimate"]
    if estimate is None:
        say(console, "estimate  none yet")
    else:
        why = f": {estimate['reason']}" if estimate["reason"] else ""
        say(console, f"estimate  {estimate['status']}{why}, {estimate['age_s']:,.0f} s old")
        for name, x in estimate["parameters"].items():
            if x is not None:
                say(console, f"  {name:24} {x['mean']:,.4g} ({x['q05']:,.4g} .. {x['q95']:,.4g})")
        say(console, f"coverage  {100 * estimate['coverage']['fraction']:.0f} %, {estimate['samples']:,} samples")
    worker = content["estimator"]
    say(console, f"sampler   {worker['conclusion_s']:.2f} s, at most {worker['longest_conclusion_s']:.2f} s")
    transmit = content["transmit"]
    if not transmit["enabled"]:
        say(console, "transmit  off: listening only")
        return
    address = "no address" if transmit["address"] is None else f"address 0x{transmit['address']:02X}"
    fault = f"; {transmit['fault']}" if transmit["fault"] else ""
    say(console, f"transmit  {address}{fault}; {transmit['published']:,} frames sent, {transmit['failed']:,} failed")
    for reason, count in transmit["withheld"].items():
        say(console, f"withheld  {reason} {count:,}")

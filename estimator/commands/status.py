"""The subcommand `status`: the state of a running daemon, from its status file.

Other programs call it every few seconds, so it imports no numerical package.
"""

import argparse
from pathlib import Path

import msgspec
from rich.console import Console
from rich.text import Text

from estimator import config
from estimator.answers.run import RoadNow
from estimator.answers.status import NotRunningAnswer, State, StatusAnswer
from estimator.commands.arguments import add_output
from estimator.commands.complaints import complain
from estimator.commands.terminal import print_json, say, standard_output
from estimator.daemon.service import folders, status_file
from estimator.printable import printable

COLOURS = {
    State.WAITING: "yellow",
    State.LISTENING: "yellow",
    State.SILENT: "yellow",
    State.RECEIVING: "green",
    State.FAULT: "red",
}


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
        missing = f"there is no {' nor '.join(map(str, places))}"
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
        _print_status(standard_output(), status)
    return 1 if reason else 0


def _print_status(console: Console, status: StatusAnswer) -> None:
    """A screenful for people."""
    detail, colour = f": {status.detail}" if status.detail else "", COLOURS[status.state]
    console.print(Text.assemble((status.state.value, f"bold {colour}"), printable(detail)), soft_wrap=True)
    for name, link in (("input", status.input), ("output", status.output)):
        if link is None:
            continue
        rate = f", {status.frames_per_s or 0:,.0f} per s" if name == "input" else ""
        say(console, f"{name:9} {link.bus}: {link.frames:,} frames{rate}; re-opened {link.reopened} times")
        losses = {"kernel": link.kernel_drops, "queue": link.queue_drops}
        lost = ", ".join(f"{n:,} in the {place}" for place, n in losses.items() if n) or "none"
        say(console, f"lost      {lost}; error frames {link.errors:,}; clock steps {status.clock_steps}")
    for role, signal in status.signals.items():
        age = "none valid since the start" if signal.age_s is None else f"newest valid {signal.age_s:.1f} s ago"
        say(console, f"  {role:24} {signal.readings:>10,} readings, {age}")
    if status.missing:
        say(console, f"missing   {', '.join(status.missing)}")
    for path, reason in sorted(status.contested.items()):
        say(console, f"contested {path}: {reason}")
    for reason, count in sorted(status.refused.items()):
        say(console, f"refused   {reason} {count:,}")
    estimate = status.estimate
    if estimate is None:
        say(console, "estimate  none yet")
    else:
        why = f": {estimate.reason}" if estimate.reason else ""
        say(console, f"estimate  {estimate.status}{why}, {estimate.age_s:,.0f} s old")
        for name, x in msgspec.structs.asdict(estimate.parameters).items():
            if x.mean is None:
                say(console, f"  {name:24} {x.status}: {x.reason}")
            else:
                say(console, f"  {name:24} {x.mean:,.4g} ({x.q05:,.4g} .. {x.q95:,.4g})")
        if status.road_now is not None:
            say(console, f"road now  {_told(status.road_now)}")
        say(console, f"coverage  {100 * estimate.coverage.fraction:.0f} %, {estimate.samples:,} samples")
    if status.failed_updates:
        say(console, f"failed    {status.failed_updates:,} updates, numerically")
    worker = status.estimator
    say(console, f"sampler   {worker.conclusion_s:.2f} s, at most {worker.longest_conclusion_s:.2f} s")
    transmit = status.transmit
    if not transmit.enabled:
        say(console, "transmit  off: listening only")
        return
    address = "no address" if transmit.address is None else f"address 0x{transmit.address:02X}"
    fault = f"; {transmit.fault}" if transmit.fault else ""
    say(console, f"transmit  {address}{fault}; {transmit.published:,} frames sent, {transmit.failed:,} failed")
    for reason, count in transmit.withheld.items():
        say(console, f"withheld  {reason} {count:,}")


def _told(road: RoadNow) -> str:
    """The road under the vehicle in words."""
    height = "" if road.height_m is None else f", {road.height_m:+.0f} +- {road.height_sd_m:.0f} m above the start"
    return f"{road.grade_percent:+.2f} +- {road.sd_percent:.2f} %{height}"

"""The status of a daemon on the terminal; light, for `status` imports no numerical package."""

from rich.console import Console
from rich.text import Text

from estimator.answers.run import RoadNow
from estimator.answers.status import State, StatusAnswer
from estimator.commands.estimate_table import STYLES, print_estimate
from estimator.commands.terminal import say
from estimator.estimates import Status
from estimator.printable import printable
from estimator.report import wanted_driving
from estimator.report.number_format import clock
from estimator.report.parameter_text import ROWS, cells, references, road

COLOURS = {
    State.WAITING: "yellow",
    State.LISTENING: "yellow",
    State.SILENT: "yellow",
    State.RECEIVING: "green",
    State.FAULT: "red",
}


def print_status(console: Console, status: StatusAnswer) -> None:
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
    _print_estimate(console, status)
    if status.road_now is not None:
        say(console, f"road now  {_told(status.road_now)}")
    for line in references(status.references):
        say(console, f"others    {line}")
    if status.failed_updates:
        say(console, f"failed    {status.failed_updates:,} updates, numerically")
    worker = status.estimator
    say(console, f"sampler   {worker.conclusion_s:.2f} s, at most {worker.longest_conclusion_s:.2f} s")
    for name, output in status.outputs.items():
        there = "connected" if output.connected else "not connected"
        problem = f"; {printable(output.problem)}" if output.problem else ""
        say(console, f"{name:9} {output.address}: {there}, {output.sent:,} reports sent{problem}")
    transmit = status.transmit
    if not transmit.enabled:
        say(console, "transmit  off: listening only")
        return
    address = "no address" if transmit.address is None else f"address 0x{transmit.address:02X}"
    fault = f"; {transmit.fault}" if transmit.fault else ""
    say(console, f"transmit  {address}{fault}; {transmit.published:,} frames sent, {transmit.failed:,} failed")
    for reason, count in transmit.withheld.items():
        say(console, f"withheld  {reason} {count:,}")


def _print_estimate(console: Console, status: StatusAnswer) -> None:
    """The estimate as `estimate` prints it, or how far it is to the first one."""
    estimate, progress = status.estimate, status.progress
    if estimate is None:
        say(console, "estimate  none yet")
    else:
        why = f": {estimate.reason}" if estimate.reason else ""
        style = f"bold {STYLES[estimate.status]}"
        age = f", concluded {clock(estimate.age_s)} ago"
        console.print(Text.assemble("estimate  ", (estimate.status.value, style), printable(why), age), soft_wrap=True)
        if estimate.doubt:
            say(console, f"warning   {estimate.doubt}")
        if estimate.status is Status.ESTIMATED:
            print_estimate(console, estimate.parameters, estimate.coefficients)
        for row in ROWS:
            x = row.of(estimate.parameters)
            if x.mean is None and estimate.status is Status.ESTIMATED:
                say(console, f"{row.name:9} {x.status.value}: {x.reason}")
        if estimate.road is not None:
            say(console, f"road      {road(estimate.road)}")
        c = estimate.coverage
        if c.available:
            say(console, f"coverage  {cells(c)}")
    if progress is None:
        return
    is_estimated = estimate is not None and estimate.status is not Status.UNESTIMATED
    steps = wanted_driving.steps_to_estimate(progress, None if estimate is None else estimate.coverage)
    if steps and not is_estimated:
        say(console, f"to go     {steps}")
    if wanted := wanted_driving.wanted(progress.coverage_map):
        say(console, f"wanted    {wanted}")
    rejected = sorted(status.samples_rejected.items(), key=lambda item: -item[1])
    unused = ", ".join(f"{reason} {count:,}" for reason, count in rejected if count)
    say(console, f"samples   {progress.samples:,} used; not used: {unused or 'none'}")


def _told(road: RoadNow) -> str:
    """The road under the vehicle in words."""
    height = "" if road.height_m is None else f", {road.height_m:+.0f} ± {road.height_sd_m:.0f} m above the start"
    return f"{road.grade_percent:+.2f} ± {road.sd_percent:.2f} %{height}"

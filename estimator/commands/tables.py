"""The estimate and the inspection on the terminal."""

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from estimator.answers.binding import BindingAnswer
from estimator.answers.inspection import InspectionAnswer
from estimator.commands.estimate_table import STYLES, print_estimate
from estimator.commands.terminal import say
from estimator.model.effects import unbound
from estimator.printable import printable
from estimator.report import parameter_text, summary, usual_units
from estimator.report.effect_sizes import effect_size
from estimator.report.next_step import next_step
from estimator.roles import Role
from estimator.streaming.replay import Run

MIN_GAP = 1.0  # s: shorter gaps of the rows have no line


def print_run(console: Console, run: Run, truth: dict[str, float] | None = None) -> None:
    """The estimate with its intervals, why there is none, and what went in; ``truth`` by mass, A, C where known."""
    final = run.final
    reason = f": {final.reason}" if final.reason else ""
    console.print(
        Text.assemble((final.status.value, f"bold {STYLES[final.status]}"), printable(reason)), soft_wrap=True
    )
    if advice := next_step(run):
        say(console, f"to do     {advice}")
    for warning in summary.warnings(run):
        say(console, f"warning   {warning}")
    if final.mass is not None:
        print_estimate(console, summary.parameters(final), summary.coefficients(final), truth)
    for key, reason in final.withheld.items():
        say(console, f"{key:9} unestimated: {reason}")
    for line in parameter_text.references(summary.references(run.pipeline, final)):
        say(console, f"others    {line}")
    _print_fit(console, run)
    _print_traffic(console, run)
    if run.broadcast:
        say(console, f"broadcast {len(run.broadcast):,} frames")


def _print_fit(console: Console, run: Run) -> None:
    """Road, effects, lag, air, coverage, sampler, load and samples of the last estimate."""
    final, estimator = run.final, run.pipeline.estimator
    if (road := summary.road(final)) is not None:
        say(console, f"road      {parameter_text.road(road)}")
    beside = [effect.name for effect in unbound(run.pipeline.config.binding.keys()).values()]
    for name in [*run.pipeline.effects, *beside]:
        size = final.effects.get(name)
        found = "" if size is None else f": {effect_size(name, size)}"
        say(console, f"effect    {name}{found}")
    evidence = estimator.evidence
    if evidence is not None:
        say(console, f"lag       power comes {evidence.lag:.2f} s after speed, and has been aligned")
    c, k = final.coverage, final.convergence
    if c.available:
        say(console, f"coverage  {parameter_text.cells(c)}")
    if k is not None and final.rms is not None:
        chains = f"R-hat {k.r_hat:.3f}, {k.ess_bulk:,.0f} effective draws, {100 * k.acceptance:.0f} % accepted"
        say(console, f"sampler   {chains}; residual {final.rms / 1e3:.1f} kW (rms of means over 1 s)")
    if final.load is not None:
        change, load = final.load, "the load changed" if final.load.probability > 0.5 else "the load is the same"
        sure = max(change.probability, 1 - change.probability)
        masses = f"{change.before:,.0f} kg before, {change.after:,.0f} kg after"
        say(console, f"stop      {load}, probability {sure:.3f}: {masses}")
    if estimator.failed_updates:
        say(console, f"failed    {estimator.failed_updates:,} of {len(run.updates):,} updates, numerically")
    rejected = ", ".join(f"{reason} {count:,}" for reason, count in estimator.rejected.most_common())
    say(console, f"samples   {final.admitted:,} used; not used: {rejected or 'none'}")


def _print_traffic(console: Console, run: Run) -> None:
    """Frames read, refused and put in order, steps of time, and gaps."""
    traffic = run.pipeline.traffic
    refused = sum((run.skipped + traffic.errors).values())
    say(console, f"frames    {traffic.frames:,} read, {traffic.used:,} used, {refused:,} frames or values refused")
    if late := traffic.order.reordered:
        say(console, f"order     {late:,} frames came late, by up to 1 s, and were put in order")
    for start, end in traffic.rows.gaps:
        if end < start:
            times = f"from {start - run.start:.1f} s to {end - run.start:.1f} s"
            say(console, f"step      time steps back {times}: another drive")
        if end - start >= MIN_GAP:
            times = f"{start - run.start:.1f} s to {end - run.start:.1f} s"
            say(console, f"gap       no speed or no power from {times}: not bridged")


def print_inspection(console: Console, found: InspectionAnswer) -> None:
    """Inputs found and missing, and whether an estimate can come of them."""
    frames = found.frames
    say(
        console,
        f"{found.log}: {found.duration_s:,.1f} s, {frames.read:,} frames of {frames.ids} ids, {frames.used:,} used",
    )
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in ("input", "signal", "from", "rate", "n/a", "range", "gaps"):
        table.add_column(heading, overflow="fold", no_wrap=heading == "input")
    for role, x in found.inputs.items():
        source = found.sources.get(x.signal)
        rate = "" if x.rate_Hz is None else f"{x.rate_Hz:.1f} Hz"
        values = "none valid"
        if x.minimum is not None and x.maximum is not None:
            values = usual_units.between(Role(role.partition(" ")[0]), x.minimum, x.maximum)  # as in "wheel_speeds 2"
        gaps = ", ".join(f"{a:.1f}-{b:.1f} s" for a, b in x.gaps_s[:3])
        more = f" (+{len(x.gaps_s) - 3})" if len(x.gaps_s) > 3 else ""
        address = "" if source is None else f"0x{source:02X}"
        table.add_row(
            role, Text(printable(x.signal)), address, rate, f"{100 * x.not_available:.1f} %", values, gaps + more
        )
    console.print(table)
    if found.inputs and found.missing:
        missing = ", ".join(f"{role} ({signal})" for role, signal in found.missing.items())
        say(console, f"missing: {missing}")
    if not found.inputs and found.busiest:
        say(console, f"most frequent ids: {', '.join(f'{busy.id} ({busy.frames:,} frames)' for busy in found.busiest)}")
    if frames.reordered:
        say(console, f"put in order of time: {frames.reordered:,} frames")
    if frames.steps_back:
        say(console, f"time steps back: {frames.steps_back:,} times, each the start of another drive")
    for reason, count in sorted(frames.errors.items()):
        say(console, f"refused: {reason} {count:,}")
    for warning in found.warnings:
        say(console, f"warning: {warning}")
    reason = f": {found.reason}" if found.reason else ""
    say(console, f"{found.status}{reason}; coverage {100 * found.coverage:.0f} %")


def print_binding(console: Console, found: BindingAnswer) -> None:
    """Print the signals that a configuration binds, as a table."""
    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in ("input", "signal", "message", "unit", "range", "on"):
        table.add_column(heading, overflow="fold", no_wrap=heading == "input")
    for role, x in found.inputs.items():
        on = "" if x.on is None else ", ".join(f"{value:g}" for value in x.on)
        table.add_row(role, Text(printable(x.signal)), x.message, Text(printable(x.unit or "")), x.range, on)
    console.print(table)
    if found.reason:
        say(console, f"the configuration fits the DBC, but the model cannot be fed: {found.reason}")
    else:
        say(console, "the configuration fits the DBC; give a log or a bus to see whether its signals come")

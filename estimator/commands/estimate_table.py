"""The table of an estimate; light, for `status` imports no numerical package."""

from rich import box
from rich.console import Console
from rich.table import Table

from estimator.answers.run import Parameters
from estimator.commands.terminal import say
from estimator.estimates import Status
from estimator.report.parameter_text import ROWS

MIN_WIDTH = 52  # columns of the table
STYLES = {Status.ESTIMATED: "green", Status.UNESTIMATED: "yellow", Status.INVALID: "red"}


def print_estimate(console: Console, parameters: Parameters, truth: dict[str, float] | None = None) -> None:
    """A row for each parameter that is estimated; ``truth`` by mass, A, C where it is known.

    Where the terminal has no room for the table, a line for each value and one for each interval.
    """
    if console.width >= MIN_WIDTH:
        console.print(_table(parameters, truth))
        return
    for row in ROWS:
        x = row.of(parameters)
        if x.mean is not None and x.q05 is not None and x.q95 is not None:
            say(console, f"{row.name:4} {row.value(x.mean)}")
            say(console, f"     {row.interval(x.q05, x.q95)}")


def _table(parameters: Parameters, truth: dict[str, float] | None) -> Table:
    table = Table("", "mean", "90 % interval", "sd", *(["truth"] if truth else []), box=box.SIMPLE_HEAD, pad_edge=False)
    for row in ROWS:
        x = row.of(parameters)
        if x.mean is None or x.sd is None or x.q05 is None or x.q95 is None:
            continue
        cells = [row.name, row.value(x.mean), row.interval(x.q05, x.q95), f"{100 * x.sd / x.mean:.2f} %"]
        table.add_row(*cells, *([row.form.format(truth[row.name])] if truth else []))
    return table

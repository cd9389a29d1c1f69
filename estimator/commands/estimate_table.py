"""The table of an estimate; light, for `status` imports no numerical package."""

from rich import box
from rich.console import Console
from rich.table import Table

from estimator.answers.run import Coefficients, Parameters
from estimator.commands.terminal import say
from estimator.estimates import Status
from estimator.report.parameter_text import Known, air, coast_down, known

MIN_WIDTH = 52  # columns of the table
STYLES = {Status.ESTIMATED: "green", Status.UNESTIMATED: "yellow", Status.INVALID: "red"}


def print_estimate(
    console: Console,
    parameters: Parameters,
    coefficients: Coefficients | None,
    truth: dict[str, float] | None = None,
) -> None:
    """A row for each parameter that is estimated, coast-down and air; ``truth`` by mass, A, C where it is known.

    Where the terminal has no room for the table, a line for each value and one for each interval.
    """
    rows = known(parameters, coefficients)
    if console.width >= MIN_WIDTH:
        console.print(_table(rows, truth))
    else:
        for x in rows:
            say(console, f"{x.row.name:5} {x.row.value(x.mean)}")
            say(console, f"      {x.row.interval(x.q05, x.q95)}")
    if coefficients is not None and (forces := coast_down(coefficients)):
        say(console, f"coast     {forces}")
        say(console, f"air       {air(coefficients)}")


def _table(rows: list[Known], truth: dict[str, float] | None) -> Table:
    table = Table("", "mean", "90 % interval", "sd", *(["truth"] if truth else []), box=box.SIMPLE_HEAD, pad_edge=False)
    for x in rows:
        cells = [x.row.name, x.row.value(x.mean), x.row.interval(x.q05, x.q95), f"{100 * x.sd / x.mean:.2f} %"]
        if truth:
            cells.append(x.row.text(truth[x.row.name]) if x.row.name in truth else "")
        table.add_row(*cells)
    return table

"""A diagnosis on the terminal: the verdict, then its evidence, in some 25 lines."""

from collections.abc import Iterable, Iterator

from rich.console import Console
from rich.table import Table
from rich.text import Text

from estimator.answers.diagnosis import Verdict
from estimator.components.budget import Budget
from estimator.diagnosis.result import Diagnosis, Finding, GapClosed, Shift
from estimator.printable import printable
from estimator.report import parameter_text, usual_units, wording

RANKING_ROWS, PLACE_ROWS, NAMES_IN_LINE = 6, 5, 4  # rows of the ranking, of the places, names in a line
STYLES = {Verdict.EFFECT: "cyan", Verdict.NO_GAP: "green", Verdict.UNKNOWN: "magenta", Verdict.CANNOT_TELL: "yellow"}


def print_diagnosis(console: Console, d: Diagnosis) -> None:
    """Print verdict, effects, budget, places, invisible effects, and the line for the configuration."""
    console.print(Text(wording.headline(d), f"bold {STYLES[d.verdict]}"))
    console.print(Text(printable(wording.reason(d))))
    _lines(console, _results(d))
    if d.candidates:
        console.print(_ranking(d))
    if d.budget is not None:
        console.print(_budget(d.budget))
    if d.where:
        console.print(_places(d))
    _lines(console, _limits(d))
    if configuration := wording.configuration(d):
        console.print(Text.assemble("add to the configuration: ", (configuration, "bold")), soft_wrap=True)


def _results(d: Diagnosis) -> Iterator[tuple[str, str]]:
    if len(d.logs) > 1:
        yield "logs", wording.logs(d)
    steps = wording.ladder(d)
    if steps:
        residual = ", ".join(f"{name} {wording.kilowatts(rms)}" for name, rms in steps)
        yield "residual", f"{residual}; noise floor {wording.kilowatts(d.noise_floor)} (rms of means over 2 s)"
    for effect in d.effects:
        yield "found", _found(d, effect)
    if d.effects and d.base is not None and d.final is not None:
        change = Shift(d.final.mass - d.base.mass, d.final.A - d.base.A, d.final.C - d.base.C)
        moved = f"{wording.shift(change, d.deviation)}; with the effects {wording.road_load(d.final, d.deviation)}"
        yield "shift", "; ".join(filter(None, (moved, wording.of_the_longest(d))))
    for line in parameter_text.references(d.references):
        yield "others", line
    if steps:
        yield "left", f"{d.remaining_verdict.value}, log Bayes factor {wording.strength_of_rest(d)}"
    if d.p_value is not None:
        yield "p value", wording.p_value(d)
    if d.formula is not None:
        yield "formula", wording.formula(d)


def _limits(d: Diagnosis) -> Iterator[tuple[str, str]]:
    if d.invisible:
        yield "unseen", _some(f"{wording.label(i.name)} (would show: {i.shown_by})" for i in d.invisible)
    if d.not_testable:
        yield "untestable", _some(f"{wording.label(n.name)} (needs {n.needs})" for n in d.not_testable)
    for advice in wording.advice(d):
        yield "would tell", advice
    if beyond := wording.beyond_estimate(d):
        yield "estimate", beyond


def _found(d: Diagnosis, effect: Finding) -> str:
    others = ", ".join(wording.label(name) for name in effect.equivalent)
    parts = [
        wording.label(effect.name),
        wording.size(effect.magnitude),
        wording.action(effect, len(d.logs) > 1) if effect.detail or effect.span else "",
        wording.closes(d, effect),
        f"not told apart from {others}" if others else "",
    ]
    return "; ".join(filter(None, parts))


def _ranking(d: Diagnosis) -> Table:
    table = _table("effect", "probability", "log Bayes", "size", "gap closed", right=(1, 2))
    for f in d.ranking[:RANKING_ROWS]:
        row = (wording.percent(f.probability), wording.bayes(f.log_bayes_factor), wording.size(f.magnitude))
        table.add_row(*map(Text, (wording.label(f.name), *row, wording.interval(f.gap_closed))))
    return table


def _budget(budget: Budget) -> Table:
    table = _table("residual", "share", "of its own", "left once added alone", "left if known alone", right=(2, 3, 4))
    for part in budget.parts:
        share = wording.interval(GapClosed(part.share, part.q05, part.q95))
        powers = [wording.kilowatts(power) for power in (part.rms, part.held_out_rms, part.expected)]
        table.add_row(*map(Text, (wording.cause(part), share, *powers)))
    return table


def _places(d: Diagnosis) -> Table:
    where = f"where the {wording.base_name(d)} errs"
    table = _table(where, "from", "to", "mean residual", "of the square", right=(1, 2, 3, 4))
    for p in d.where[:PLACE_ROWS]:
        ends = usual_units.ends(p.start, p.end, p.unit)
        row = (wording.label(p.axis), *ends, wording.kilowatts(p.bias), wording.percent(p.share))
        table.add_row(*map(Text, row))
    return table


def _table(*headings: str, right: tuple[int, ...]) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, 3, 0, 0), header_style="dim")
    for i, heading in enumerate(headings):
        table.add_column(heading, justify="right" if i in right else "left")
    return table


def _lines(console: Console, lines: Iterable[tuple[str, str]]) -> None:
    grid = Table.grid("", "", padding=(0, 1))
    for heading, text in lines:
        grid.add_row(Text(heading, "dim"), Text(printable(text)))
    if grid.row_count:
        console.print(grid)


def _some(items: Iterable[str]) -> str:
    shown = list(items)
    more = f"; and {len(shown) - NAMES_IN_LINE} more" if len(shown) > NAMES_IN_LINE else ""
    return "; ".join(shown[:NAMES_IN_LINE]) + more

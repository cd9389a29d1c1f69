"""The score as tables for a terminal, a page and other programs."""

from collections.abc import Sequence
from dataclasses import asdict
from math import isnan
from typing import Any

from rich.console import Console
from rich.table import Table

from blind.case import Measure
from blind.score import Score

SHOWN = 8  # failures that a line lists


def show(result: Score, console: Console) -> None:
    """Print all tables."""
    for title, measures in _sections(result):
        table = Table("measure", "goal", "value", "95 % interval", "drives", "to look at", title=title)
        for measure in measures:
            table.add_row(*as_row(measure), " ".join(_failures(measure)))
        console.print(table)
    table = Table("truth", "named first", title="first name by true effect")
    for truth, said in result.confusion.items():
        table.add_row(truth, _said(said))
    console.print(table)
    if result.failed:
        console.print(f"no answer: {', '.join(result.failed)}")


def as_json(result: Score) -> dict[str, Any]:
    """JSON keys are the fields of `Score`; a measure without drives is null."""

    def plain(value: Any) -> Any:
        if isinstance(value, float) and isnan(value):
            return None
        if isinstance(value, dict):
            return {key: plain(inner) for key, inner in value.items()}
        return [plain(inner) for inner in value] if isinstance(value, list | tuple) else value

    content: dict[str, Any] = plain(asdict(result))
    return content


def as_markdown(result: Score) -> str:
    """Sections with one table each."""
    lines = []
    for title, measures in _sections(result):
        lines += [f"## {title}", "", "| measure | goal | value | 95 % interval | drives |", "|---|---|---|---|---|"]
        lines += [f"| {' | '.join(as_row(measure))} |" for measure in measures] + [""]
    lines += ["## First name by true effect", "", "| truth | named first |", "|---|---|"]
    lines += [f"| {truth} | {_said(said)} |" for truth, said in result.confusion.items()]
    return "\n".join(lines) + "\n"


def _sections(result: Score) -> tuple[tuple[str, Sequence[Measure]], ...]:
    return (
        ("Measures", result.measures),
        ("By noise of the sensors", result.by_noise),
        ("Named first, by effect, oracle > 10", result.by_effect),
    )


def as_row(measure: Measure) -> tuple[str, ...]:
    """Name, goal, value, interval and number of drives as text."""
    estimate = measure.estimate
    if isnan(estimate.value):
        return measure.name, measure.goal, "-", "-", "0"
    value, low, high = (_number(x, measure.unit) for x in (estimate.value, estimate.low, estimate.high))
    unit = f" {measure.unit}".rstrip()
    return measure.name, measure.goal, f"{value}{unit}", f"{low} .. {high}{unit}", str(estimate.n)


def _number(x: float, unit: str) -> str:
    return f"{100 * x:.1f}" if unit == "%" else f"{x:.3g}"


def _failures(measure: Measure) -> list[str]:
    names = [name.removeprefix("drive-") for name in measure.failures[:SHOWN]]
    more = len(measure.failures) - len(names)
    return [*names, f"+{more}"] if more else names


def _said(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" if count > 1 else name for name, count in counts.items())

"""The figures of a score as tables."""

from typing import Any

from harness.check import Cells, Table

SECTIONS = {
    "measures": "Measures",
    "by_effect": "Named first, by effect, oracle > 10",
}
COLUMNS = ("measure", "goal", "value", "95 % interval", "drives")
HEADLINE = Cells(
    rows=(
        "named first, or its class: oracle > 10",
        "false alarm on a clean",
        "outside the catalogue",
        "two effects: both named",
        "processor time for a log, 95 %",
    ),
    columns=("value", "95 % interval"),
)


def tables(figures: dict[str, Any]) -> list[Table]:
    """All measures, and the first names by true effect."""
    found = [Table(title, COLUMNS, [row(one) for one in figures[key]]) for key, title in SECTIONS.items()]
    names = [[truth, _said(said)] for truth, said in figures["confusion"].items()]
    return [*found, Table("First name by true effect", ("truth", "named first"), names)]


def row(measure: dict[str, Any]) -> list[str]:
    """Name, goal, value, interval and number of drives as text."""
    estimate = measure["estimate"]
    if estimate["value"] is None:
        return [measure["name"], measure["goal"], "-", "-", "0"]
    value, low, high = (_number(estimate[key], measure["unit"]) for key in ("value", "low", "high"))
    unit = f" {measure['unit']}".rstrip()
    return [measure["name"], measure["goal"], f"{value}{unit}", f"{low} .. {high}{unit}", str(estimate["n"])]


def _number(x: float, unit: str) -> str:
    return f"{100 * x:.1f}" if unit == "%" else f"{x:.3g}"


def _said(counts: dict[str, int]) -> str:
    return ", ".join(f"{name} {count}" if count > 1 else name for name, count in counts.items())

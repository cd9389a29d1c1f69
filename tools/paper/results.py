"""What the page is made of: all results, and numbers as text."""

import textwrap
from collections.abc import Iterable
from dataclasses import dataclass

from estimator.sampling.identifiability import EigenMetrics
from estimator.signals import Floats
from paper.cycles import Cycle
from paper.estimation import Availability, Estimate
from paper.experiments import DummyCase, Levene, ScheduleEffect, TableFive
from paper.vehicles import NAMES, PAPER_UNITS, TO_SI

WIDTH = 118  # characters
UNKNOWN = "not at hand"
DIGITS = (1, 4, 1)  # of A, C, m in the paper's units
PARAMETERS = [f"{name} [{unit}]" for name, unit in zip(NAMES, PAPER_UNITS, strict=True)]


@dataclass(frozen=True)
class Results:
    """Everything that is on the page; keys are names of cycles, arrays of parameters are [A, C, m]."""

    cycles: list[Cycle]
    dummy: list[DummyCase]
    runs: dict[str, list[Estimate]]
    selection: dict[str, dict[str, Floats]]
    levene_estimates: list[Levene]
    levene_residuals: Levene
    eigen: TableFive
    schedules: list[ScheduleEffect]
    reach: Availability
    coverage: tuple[Floats, Floats]
    noise: dict[str, Floats]
    duration: dict[str, tuple[Floats, Floats]]


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A markdown table."""
    header = list(header)
    lines = [header, ["---"] * len(header), *map(list, rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def values(theta: Floats, sd: Floats | None = None) -> list[str]:
    """Parameters in the paper's units, with their sd where given."""
    theta = theta / TO_SI
    if sd is None:
        return [f"{x:.{d}f}" for x, d in zip(theta, DIGITS, strict=True)]
    return [f"{x:.{d}f} ± {s:.{d}f}" for x, s, d in zip(theta, sd / TO_SI, DIGITS, strict=True)]


def percent(fractions: Iterable[float], digits: int = 1, sign: str = "+") -> list[str]:
    """Fractions as percentages, signed unless ``sign`` is empty."""
    return [f"{round(100 * x, digits) + 0.0:{sign}.{digits}f} %" for x in fractions]


def listed(words: Iterable[str]) -> str:
    """Words as English lists them."""
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last


def nearest(metrics: EigenMetrics) -> Floats:
    """Angle [deg] of every parameter's axis to the eigenvector nearest to it."""
    return metrics.angles.min(axis=0)


def reflow(text: str) -> str:
    """Paragraphs wrapped anew; tables, headings and images as they are."""
    blocks = text.strip().split("\n\n")
    wrapped = (b if b[0] in "|#!" else textwrap.fill(b, WIDTH, break_on_hyphens=False) for b in blocks)
    return "\n\n".join(wrapped) + "\n"

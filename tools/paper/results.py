"""All results on the page, and the formatting of numbers and text."""

import textwrap
from collections.abc import Iterable
from dataclasses import dataclass

from estimator.sampling.identifiability import EigenMetrics
from estimator.signals import Floats
from paper.cycles import Cycle
from paper.estimation import Availability, Estimate
from paper.experiments import DummyCase, Levene, Scatter, ScheduleEffect, TraceFit
from paper.studies import CoverageStudy, DurationStudy, NoiseStudy
from paper.table_five import Match
from paper.vehicle_posterior import VehiclePosterior
from paper.vehicles import NAMES, PAPER_UNITS, TO_SI

WIDTH = 118  # characters
DIGITS = (1, 4, 1)  # of A, C, m in the paper's units
PARAMETERS = [f"{name} [{unit}]" for name, unit in zip(NAMES, PAPER_UNITS, strict=True)]


@dataclass(frozen=True, kw_only=True)
class Results:
    """Everything that is on the page; keys are names of cycles, arrays of parameters are [A, C, m]."""

    cycles: dict[str, Cycle]
    dummy: list[DummyCase]
    runs: dict[str, list[Estimate]]
    trace: TraceFit
    scatter: dict[str, Scatter]
    selection: dict[str, dict[str, Floats]]
    levene_printed: list[Levene]
    levene_here: list[Levene]
    matches: list[Match]
    scaled: dict[str, EigenMetrics]
    vehicle: dict[float, VehiclePosterior]
    schedules: list[ScheduleEffect]
    reach: Availability
    coverage: dict[str, CoverageStudy]
    noise: dict[str, NoiseStudy]
    duration: dict[str, DurationStudy]
    copies: tuple[Floats, Floats]


def table(header: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """A markdown table."""
    header = list(header)
    lines = [header, ["---"] * len(header), *map(list, rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def values(theta: Floats, sd: Floats | None = None) -> list[str]:
    """Parameters [A, C, m] in SI as text in the paper's units, with their sd where given."""
    return printed_values(theta / TO_SI, None if sd is None else sd / TO_SI)


def printed_values(theta: Floats, sd: Floats | None = None) -> list[str]:
    """Parameters [A, C, m] in the paper's units as text, with their sd where given."""
    if sd is None:
        return [f"{x:.{d}f}" for x, d in zip(theta, DIGITS, strict=True)]
    return [f"{x:.{d}f} ± {s:.{d}f}" for x, s, d in zip(theta, sd, DIGITS, strict=True)]


def percent(fractions: Iterable[float], digits: int = 1, sign: str = "+") -> list[str]:
    """Fractions as percentages, signed unless ``sign`` is empty."""
    return [f"{round(100 * x, digits) + 0.0:{sign}.{digits}f} %" for x in fractions]


def listed(words: Iterable[str]) -> str:
    """Words as English lists them."""
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last


def reflow(text: str) -> str:
    """Paragraphs wrapped anew; tables, headings and images as they are."""
    blocks = text.strip().split("\n\n")
    wrapped = (b if b[0] in "|#!" else textwrap.fill(b, WIDTH, break_on_hyphens=False) for b in blocks)
    return "\n\n".join(wrapped) + "\n"

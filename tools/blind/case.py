"""One drive with its answer, and one line of the table of measures."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from harness.scores import Estimate, share

from blind import answer
from blind.answer import Run
from blind.truth import DETECTABLE, Truth


@dataclass(frozen=True, slots=True)
class Case:
    """A drive with its truth and the answer given."""

    truth: Truth
    run: Run

    @property
    def has_gap(self) -> bool:
        """Whether no effect of the drive is modelled by default, so that there is a gap to find."""
        return not self.truth.shown

    @property
    def first_name(self) -> str:
        """The effect named first, or the verdict where none is named."""
        return self.run.named[0].name if self.run.named else self.run.verdict


@dataclass(frozen=True, slots=True, kw_only=True)
class Measure:
    """One line of the table; ``failures`` are drives for a closer look."""

    name: str
    goal: str
    estimate: Estimate
    unit: str = "%"
    failures: tuple[str, ...] = ()


def share_of(
    name: str, goal: str, cases: Iterable[Case], right: Callable[[Case], bool], lower: bool = False
) -> Measure:
    """Share of cases for which ``right`` holds; ``lower``: the goal is a small share."""
    judged = [(case.truth.drive, right(case)) for case in cases]
    failures = tuple(drive for drive, holds in judged if holds is lower)
    return Measure(
        name=name, goal=goal, estimate=share(sum(holds for _, holds in judged), len(judged)), failures=failures
    )


def is_visible(case: Case) -> bool:
    """Whether every effect of the drive is visible to the oracle."""
    return case.has_gap and case.truth.log_bayes_factor > DETECTABLE


def right_first(case: Case) -> bool:
    """Whether the first name is right."""
    return answer.first_is_right(case.truth, case.run)


def claimed(case: Case) -> bool:
    """Whether the answer claims a gap with a cause, known or unknown, or there is none."""
    return case.run.verdict in ("effect", "unknown effect", "error")

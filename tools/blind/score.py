"""Score the answers: measures with their goals, intervals and failed drives."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from blind.answer import Run
from blind.case import Case, Measure, is_visible, right_first, share_of
from blind.naming import naming
from blind.quality import cost, gap_closed_and_times, parameters, probabilities
from blind.truth import Truth


@dataclass(frozen=True, slots=True, kw_only=True)
class Score:
    """All tables: measures, those by effect, and the confusion of names."""

    measures: tuple[Measure, ...]
    by_effect: tuple[Measure, ...]
    confusion: dict[str, dict[str, int]]  # truth: counts of first names
    failed: tuple[str, ...]  # drives without an answer


def pair(truths: dict[str, Truth], runs: dict[str, Run]) -> list[Case]:
    """Truths with their answers; drives without an answer are left out."""
    return [Case(truth, runs[drive]) for drive, truth in truths.items() if drive in runs]


def score(cases: Sequence[Case]) -> Score:
    """Compute all tables from the cases."""
    return Score(
        measures=(
            *naming(cases),
            *probabilities(cases),
            *gap_closed_and_times(cases),
            *parameters(cases),
            *cost(cases),
        ),
        by_effect=tuple(_by_effect(cases)),
        confusion=confusion(cases),
        failed=tuple(case.truth.drive for case in cases if case.run.answer is None),
    )


def _by_effect(cases: Sequence[Case]) -> Iterable[Measure]:
    single = [c for c in cases if c.truth.kind == "single" and is_visible(c)]
    for name in sorted({c.truth.effects[0].world for c in single}):
        these = [c for c in single if c.truth.effects[0].world == name]
        yield share_of(name, ">= 95 %", these, right_first)


def confusion(cases: Sequence[Case]) -> dict[str, dict[str, int]]:
    """First name by true effect; invisible effects have their own rows."""
    rows: dict[str, Counter[str]] = {}
    for case in cases:
        truth = case.truth
        name = " + ".join(sorted(effect.world for effect in truth.effects)) or "clean"
        if truth.kind == "pair":
            name = "pair: " + name
        elif truth.shown:
            name += " (modelled by default)"
        elif truth.effects and truth.stratum != "oracle > 10":
            name += f" ({truth.stratum})"
        said = "+".join(f.name for f in case.run.named) if truth.kind == "pair" and case.run.named else case.first_name
        rows.setdefault(name, Counter())[said] += 1
    return {name: dict(said.most_common()) for name, said in sorted(rows.items())}

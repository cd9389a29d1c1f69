"""Measures of naming: right names, false alarms, effects outside the catalogue, two effects at once."""

from collections.abc import Sequence

from blind import answer
from blind.case import Case, Measure, claimed, is_visible, right_first, share_of
from blind.truth import DETECTABLE, HIDDEN


def naming(cases: Sequence[Case]) -> list[Measure]:
    """Measures of right names, false alarms, unknown effects and pairs."""
    kinds = {kind: [c for c in cases if c.truth.kind == kind] for kind in ("clean", "single", "pair", "outside")}
    middling = [c for c in kinds["single"] if c.has_gap and HIDDEN <= c.truth.log_bayes_factor <= DETECTABLE]
    hidden = [c for c in kinds["single"] if not c.has_gap or c.truth.log_bayes_factor < HIDDEN]
    clear = [c for c in kinds["single"] if is_visible(c)]
    outside = [c for c in kinds["outside"] if is_visible(c)]
    pairs = [c for c in kinds["pair"] if is_visible(c)]
    level = [c for c in pairs if all(effect.world != "grade" for effect in c.truth.effects)]
    blind = [c for c in pairs if c not in level and {"grade", "altitude"} <= set(c.truth.without)]

    def wrong(case: Case) -> bool:  # a diagnosis that failed counts against the program
        return case.run.answer is None or bool(answer.invented(case.truth, case.run))

    return [
        share_of("named first, or its class: oracle > 10", ">= 95 %", clear, right_first),
        share_of("... by one name alone, oracle > 10", "-", clear, lambda c: answer.is_alone(c.run) and right_first(c)),
        share_of("... a wrong name, oracle > 10", "low", clear, wrong, lower=True),
        share_of("named first, or its class: oracle 1..10", "-", middling, right_first),
        share_of("... a wrong name, oracle 1..10", "low", middling, wrong, lower=True),
        share_of("nothing claimed: oracle < 1, or modelled by default", ">= 98 %", hidden, lambda c: c.run.is_silent),
        share_of("false alarm on a clean drive", "<= 1 %", kinds["clean"], claimed, lower=True),
        share_of(
            "outside the catalogue: unknown effect", ">= 90 %", outside, lambda c: c.run.verdict == "unknown effect"
        ),
        share_of("outside the catalogue: a wrong name", "<= 5 %", kinds["outside"], wrong, lower=True),
        share_of("two effects: both named", ">= 85 %", pairs, lambda c: all(answer.found(c.truth, c.run))),
        share_of("... no grade among them", "-", level, lambda c: all(answer.found(c.truth, c.run))),
        share_of("... a grade that no signal shows", "-", blind, lambda c: all(answer.found(c.truth, c.run))),
        share_of("two effects: at least one named", ">= 98 %", pairs, lambda c: any(answer.found(c.truth, c.run))),
        share_of("two effects: a wrong name besides", "low", pairs, wrong, lower=True),
    ]

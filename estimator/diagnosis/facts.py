"""Facts behind the sentences of a report: remainder, doubtful candidate, advice, effects to configure."""

from estimator.answers.diagnosis import Verdict
from estimator.diagnosis.outcome import Outcome
from estimator.diagnosis.result import HIDDEN_GRADE, Advice, Doubtful, Finding, Remainder
from estimator.model.design_matrix import Term
from estimator.model.effects import BY_NAME, Effect


def remainder(outcome: Outcome) -> Remainder:
    """The process with most evidence in the final residual."""
    left = outcome.left
    return Remainder(left.name, left.variance**0.5, left.log_bayes_factor)


def doubtful(outcome: Outcome, verdict: Verdict, named: tuple[Finding, ...]) -> Doubtful | None:
    """The best candidate of a "cannot tell" without named effects; else None."""
    if verdict is not Verdict.CANNOT_TELL or named:
        return None
    best = outcome.result.ranking[0]
    return Doubtful(best.name, best.log_bayes_factor <= outcome.thresholds.min_log_bf(best.is_timed, others=0))


def advice(outcome: Outcome, verdict: Verdict, named: tuple[Finding, ...]) -> tuple[Advice, ...]:
    """The signal or manoeuvre that separates each effect from those that this drive cannot tell it apart from."""
    unsure: list[str] = []
    if verdict is Verdict.CANNOT_TELL:
        unsure += [named[0].name, *named[0].equivalent] if named else [outcome.result.ranking[0].name]
    elif verdict is Verdict.EFFECT:
        unsure += [other for finding in named for other in finding.equivalent]
        unsure += [finding.name for finding in named if finding.magnitude.name == HIDDEN_GRADE]
    breaks = {effect.name: effect.breaks for effect in outcome.effects}
    return tuple(Advice(name, breaks[name]) for name in dict.fromkeys(unsure) if name in breaks)


def unsettled(outcome: Outcome, verdict: Verdict, named: tuple[Finding, ...]) -> list[tuple[Effect, Effect | None]]:
    """Pairs of effects that the drive does not tell apart, the likelier one first; None: it may be nothing."""
    effects = {effect.name: effect for effect in outcome.effects}
    pairs = [(found.name, other) for found in named for other in found.equivalent]
    if named and (pairs or verdict is Verdict.EFFECT):
        return [(effects[a], effects[b]) for a, b in pairs if a in effects and b in effects]
    if verdict is not Verdict.CANNOT_TELL or not outcome.result.ranking:
        return []
    best, *others = outcome.result.ranking
    least = best.log_bayes_factor - outcome.thresholds.min_log_bf_lead
    rivals = [other.effect for other in others if other.log_bayes_factor > least]
    return [(best.effect, rival) for rival in rivals] or [(best.effect, None)]


def streaming_effects(named: tuple[Finding, ...], given: tuple[Term, ...]) -> tuple[str, ...]:
    """The ``given`` effects of the streaming model and those found that it can take; empty if it can take none."""
    found = [f.name for f in named if f.name in BY_NAME and f.magnitude.name == BY_NAME[f.name].symbol and not f.span]
    names = dict.fromkeys([*(term.effect.name for term in given), *(n for n in found if BY_NAME[n].is_streaming)])
    return tuple(names) if found else ()

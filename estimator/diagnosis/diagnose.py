"""Diagnosis of drives: where the gap is, which effects cause it, how far they reduce it, and what remains."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.answers.diagnosis import Verdict
from estimator.diagnosis import facts
from estimator.diagnosis.case import MIN_MINUTES, UNIFORM, Case
from estimator.diagnosis.conclusion import Conclusion, conclude
from estimator.diagnosis.described import described
from estimator.diagnosis.experiment import experiments
from estimator.diagnosis.explanation import explain, started
from estimator.diagnosis.findings import Findings
from estimator.diagnosis.isolability import invisible, isolability, not_testable
from estimator.diagnosis.localisation import gap_map, places
from estimator.diagnosis.power_traces import context_of, traces_of
from estimator.diagnosis.result import HIDDEN_GRADE, Diagnosis, Experiment, Finding, NotTestable
from estimator.diagnosis.surrogates import p_value
from estimator.diagnosis.thresholds import Thresholds
from estimator.model.effects import CATALOGUE, Effect
from estimator.preparation.drive import Drive

MAX_EXPERIMENTS = 3  # pairs of effects for which an experiment is proposed


def diagnose(
    drives: Sequence[Drive],
    given: tuple[Effect, ...],
    rng: np.random.Generator,
    effects: Sequence[Effect] = CATALOGUE,
    thresholds: Thresholds | None = None,
    surrogates: int = 0,
) -> Diagnosis:
    """Diagnose one drive, or several drives of one vehicle.

    Parameters
    ----------
    drives
        Drives of one vehicle.
    given
        Effects that the configuration has in the model.
    rng
        Source of the draws from posteriors and of surrogates.
    effects
        Candidates.
    thresholds
        Limits of probabilities and log Bayes factors; None: the defaults.
    surrogates
        Number of records of noise alone that are searched too, for a p-value; 0: no p-value.
    """
    limits = Thresholds() if thresholds is None else thresholds
    if drives:
        effects = [effect for effect in effects if not all(effect.is_applied(drive.known) for drive in drives)]
    cases = list[Case]()
    reason = "there is no driving in it"
    for drive in drives:
        case = Case.of(drive, given)
        if isinstance(case, Case):
            cases.append(case)
        else:
            reason = case
    missing = tuple(not_testable(effects, frozenset().union(*(drive.known for drive in drives))))
    if not cases:
        return Diagnosis(verdict=Verdict.CANNOT_TELL, obstacle=_obstacle(drives, reason), not_testable=missing)
    fitted, states = started(cases)
    if not fitted:
        return Diagnosis(verdict=Verdict.CANNOT_TELL, obstacle=UNIFORM, not_testable=missing)
    conclusion = conclude(explain(fitted, states, effects, limits), fitted, limits, rng)
    diagnosis = _report(conclusion, effects, missing)
    return replace(diagnosis, p_value=p_value(conclusion.explained, surrogates, rng)) if surrogates else diagnosis


def _obstacle(drives: Sequence[Drive], reason: str) -> str:
    """Reason why no drive can be fitted: the ``reason`` of the last one, or that all of several are too short."""
    minutes = [drive.minutes_known for drive in drives]
    if len(drives) < 2 or max(minutes) >= MIN_MINUTES:
        return reason
    return (
        f"of {len(drives)} drives the longest has {max(minutes):.1f} minutes that can be used, all together "
        f"{sum(minutes):.1f}; each is fitted by itself, so it takes one of {MIN_MINUTES:.0f} at least"
    )


def _report(conclusion: Conclusion, effects: Sequence[Effect], missing: tuple[NotTestable, ...]) -> Diagnosis:
    """Diagnosis that states a conclusion; ``missing``: the effects that these drives cannot test."""
    verdict, explained, longest = conclusion.verdict(), conclusion.explained, conclusion.longest
    findings = Findings(conclusion)
    named = findings.named()
    which = conclusion.explanation.which
    base, base_deviation = conclusion.plain
    final, deviation = conclusion.road_load
    traces = traces_of(conclusion)
    is_road_hidden = any(finding.magnitude.name == HIDDEN_GRADE for finding in named)
    ranking = findings.candidates(named)
    told = {name for finding in named for name in (finding.name, *finding.equivalent)}
    others = [effect for effect in effects if effect.name not in told and not effect.is_gravity]
    forms = [form for one in explained.ranking if (form := one.each[which]) is not None]
    remaining = conclusion.remaining()
    addable = facts.streaming_effects(named, conclusion.cases[which].given)
    return Diagnosis(
        verdict=verdict,
        effects=named,
        candidates=ranking,
        remaining_verdict=remaining,
        remaining_log_bayes_factor=conclusion.left_over,
        remainder=findings.remainder(),
        formula=described(longest) if remaining is Verdict.UNKNOWN or verdict is Verdict.UNKNOWN else None,
        doubtful=facts.doubtful(explained, verdict, named),
        noise_floor=conclusion.budget.floor,
        rms_base=conclusion.budget.base if conclusion.lag is None else conclusion.lag.rms_before,
        rms_final=conclusion.budget.reached,
        base=base,
        base_deviation=base_deviation,
        final=final,
        deviation=deviation,
        where=tuple(places(traces, context_of(conclusion))),
        isolability=isolability(longest, forms),
        not_testable=missing,
        invisible=invisible(longest, others, conclusion.thresholds.min_expected_log_bf),
        advice=facts.advice(explained, effects, verdict, named),
        experiments=_experiments(conclusion, effects, verdict, named, ranking),
        streaming_effects=addable if verdict is Verdict.EFFECT else (),
        budget=conclusion.budget,
        gap_map=gap_map(traces, traces.road_known if is_road_hidden else traces.extended),
        traces=traces,
    )


def _experiments(
    conclusion: Conclusion,
    effects: Sequence[Effect],
    verdict: Verdict,
    named: Sequence[Finding],
    ranking: Sequence[Finding],
) -> tuple[Experiment, ...]:
    pairs = facts.unsettled(conclusion.explained, effects, verdict, named)
    evidence = {finding.name: finding.log_bayes_factor for finding in ranking}
    return experiments(conclusion.longest, pairs[:MAX_EXPERIMENTS], evidence)

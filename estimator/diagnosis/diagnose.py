"""Diagnose drives: where the gap is, which effects cause it, how far they reduce it, and what remains."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.answers.diagnosis import Verdict
from estimator.diagnosis import facts
from estimator.diagnosis.case import MIN_MINUTES, UNIFORM, Case
from estimator.diagnosis.decision import Decision, decide
from estimator.diagnosis.experiment import experiments
from estimator.diagnosis.findings import candidate_findings, named_findings, remainder
from estimator.diagnosis.isolability import isolability, lasting_effects, not_testable
from estimator.diagnosis.localisation import biased_parts, gap_map
from estimator.diagnosis.power_traces import context_of, traces_of
from estimator.diagnosis.residual_formula import best_residual_formula
from estimator.diagnosis.result import HIDDEN_GRADE, Diagnosis, Experiment, Finding, NotTestable, Span
from estimator.diagnosis.road_comparison import fitted_cases, search
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
        effects = [
            effect for effect in effects if not all(effect.is_applied(drive.known_quantities) for drive in drives)
        ]
    cases = list[Case]()
    reason = "there is no driving in it"
    for drive in drives:
        case = Case.of(drive, given)
        if isinstance(case, Case):
            cases.append(case)
        else:
            reason = case
    missing = tuple(not_testable(effects, frozenset().union(*(drive.known_quantities for drive in drives))))
    if not cases:
        return Diagnosis(verdict=Verdict.CANNOT_TELL, obstacle=_obstacle(drives, reason), not_testable=missing)
    fitted, states = fitted_cases(cases)
    if not fitted:
        return Diagnosis(verdict=Verdict.CANNOT_TELL, obstacle=UNIFORM, not_testable=missing)
    result = search(fitted, states, effects, limits)
    nearer = tuple(case.beside(drive) for case, drive in zip(fitted, result.drives, strict=True))
    if nearer != fitted:  # shapes of the given effects were found without the others
        fitted, states = fitted_cases(nearer)
        result = search(fitted, states, effects, limits)
    decision = decide(result, fitted, states, limits, rng)
    diagnosis = _report(decision, effects, missing)
    return replace(diagnosis, p_value=p_value(decision.result, surrogates, rng)) if surrogates else diagnosis


def _obstacle(drives: Sequence[Drive], reason: str) -> str:
    """Reason why no drive can be fitted: the ``reason`` of the last one, or that all of several are too short."""
    minutes = [drive.minutes_known for drive in drives]
    if len(drives) < 2 or max(minutes) >= MIN_MINUTES:
        return reason
    return (
        f"of {len(drives)} drives the longest has {max(minutes):.1f} minutes that can be used, all together "
        f"{sum(minutes):.1f}; each is fitted by itself, so it takes one of {MIN_MINUTES:.0f} at least"
    )


def _report(decision: Decision, effects: Sequence[Effect], missing: tuple[NotTestable, ...]) -> Diagnosis:
    """Diagnosis that states a decision; ``missing``: the effects that these drives cannot test."""
    verdict, result, longest = decision.verdict(), decision.result, decision.longest
    named = named_findings(decision)
    number = result.longest_number
    base, base_deviation = decision.base_road_load
    final, deviation = decision.road_load
    traces = traces_of(decision)
    is_hidden_named = any(finding.magnitude.name == HIDDEN_GRADE for finding in named)
    ranking = candidate_findings(decision, named)
    reported = {name for finding in named for name in (finding.name, *finding.equivalent)}
    others = [effect for effect in effects if effect.name not in reported and not effect.is_gravity]
    tested = [term for effect in result.ranking if (term := effect.term_by_drive[number]) is not None]
    lasting, least = lasting_effects(longest, others), decision.thresholds.min_expected_log_bf
    remaining = decision.remaining()
    addable = facts.streaming_effects(named, decision.cases[number].given)
    return Diagnosis(
        verdict=verdict,
        given=tuple(effect.name for effect in decision.cases[number].given),
        effects=named,
        candidates=ranking,
        remaining_verdict=remaining,
        remaining_log_bayes_factor=decision.log_bf_unknown,
        remainder=remainder(decision),
        formula=best_residual_formula(longest) if remaining is Verdict.UNKNOWN or verdict is Verdict.UNKNOWN else None,
        doubtful=facts.doubtful(result, verdict, named),
        noise_floor=decision.budget.floor,
        rms_base=decision.budget.base if decision.lag is None else decision.lag.rms_before,
        rms_final=decision.budget.held_out_rms,
        base=base,
        base_deviation=base_deviation,
        final=final,
        deviation=deviation,
        longest=_whole(decision.cases[number].drive) if len(result.drives) > 1 else None,
        where=tuple(biased_parts(traces, context_of(decision))),
        isolability=isolability(longest, tested, lasting),
        not_testable=tuple(effect for effect in missing if effect.name not in reported),
        invisible=tuple(effect for effect in lasting if effect.expected_log_bayes_factor < least),
        advice=facts.advice(result, effects, verdict, named),
        experiments=_experiments(decision, effects, verdict, named, ranking),
        streaming_effects=addable if verdict is Verdict.EFFECT else (),
        beyond_streaming=facts.beyond_streaming(named) if verdict is Verdict.EFFECT else (),
        budget=decision.budget,
        gap_map=gap_map(traces, traces.road_known if is_hidden_named else traces.extended),
        traces=traces,
    )


def _whole(drive: Drive) -> Span:
    """All of a drive."""
    t = drive.strides.t - drive.log_start
    return Span(float(t[0]), float(t[-1]), drive.log)


def _experiments(
    decision: Decision,
    effects: Sequence[Effect],
    verdict: Verdict,
    named: Sequence[Finding],
    ranking: Sequence[Finding],
) -> tuple[Experiment, ...]:
    pairs = facts.unsettled(decision.result, effects, verdict, named)
    evidence = {finding.name: finding.log_bayes_factor for finding in ranking}
    return experiments(decision.longest, pairs[:MAX_EXPERIMENTS], evidence)

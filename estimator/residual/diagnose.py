"""Diagnose the residual of any model: which causes explain it, how far they reduce it, and where it is.

The residual is measurement less model, sample by sample. A candidate is a column: the residual that a cause of
magnitude 1 would leave. Nameless processes along every axis describe causes that are not candidates. One likelihood
gives the evidence of hypotheses, which are sets of terms, and their probabilities give the verdict.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from estimator.answers.diagnosis import Verdict
from estimator.blas_threads import one_blas_thread
from estimator.components.formula import Variable, best_formula, judged
from estimator.components.model_table import Hypothesis, ModelTable, TermGroup, weigh
from estimator.components.one_sided import above_zero
from estimator.errors import InputError
from estimator.residual.answer import Description, ResidualDiagnosis, Suspect
from estimator.residual.inputs import Axis, Candidate, Record, checked, checked_unit
from estimator.residual.noise import Noise, Scales, fit_noise
from estimator.residual.places import disagreements
from estimator.residual.shares import budget, held_out
from estimator.residual.terms import ResidualLikelihood, ResidualTerm, terms_of
from estimator.signals import Floats

LEVEL = 0.95  # smallest probability of a cause to name it
MIN_PROBABILITY_NO_GAP = 0.5  # of no cause at all, for the verdict "no gap"
MIN_PROBABILITY = 1e-3  # of a hypothesis, to include it in the average of a magnitude
MAX_ROUNDS = 4  # of fitting the noise scales and weighing the hypotheses in turn
ONE_SIDED_95 = 1.645  # standard deviations


@one_blas_thread()
def diagnose_residual(
    residual: Floats,
    columns: Mapping[str, Candidate],
    time: Floats,
    *,
    rng: np.random.Generator,
    base: Floats | None = None,
    along: Mapping[str, Axis] | None = None,
    unit: str = "",
    surrogates: int = 0,
) -> ResidualDiagnosis:
    """Diagnose a residual: which causes explain it, how far they reduce it, and where it is.

    Parameters
    ----------
    residual
        Measurement less model (n,), at least 100 samples, in ``unit``.
    columns
        Candidates by name.
    time
        Times [s] (n,) of the samples, ascending; steps may differ.
    rng
        Source of the draws for intervals and surrogates.
    base
        Columns (n, b) of the parameters of the model that are refitted: derivatives of its prediction. A cause in the
        span of these columns is not visible.
    along
        Axes of nameless processes, by name; time is always one of them.
    unit
        Unit of the residual, as a product of powers ("m/s^2"); gives the unit of a formula's coefficient.
    surrogates
        Number of records of noise alone on which the whole search is repeated, for a p-value; 99 give steps of 1 %.

    Raises
    ------
    InputError
        An argument cannot be used; the message names it and the reason.
    """
    if not isinstance(rng, np.random.Generator):
        raise InputError("rng: is no generator; give numpy.random.default_rng(seed)")
    if surrogates < 0:
        raise InputError(f"surrogates: {surrogates}; give a number of records, or 0")
    checked_unit("unit", unit)
    record = checked(residual, columns, time, base, along)
    terms, groups = terms_of(record)
    scales, likelihood, table = _weighed(record, terms, groups)
    candidates = [group for group in groups if group.is_named]
    processes = [number for group in groups if not group.is_named for number in group.terms]
    named = [group for group in candidates if table.probability_of_any(group.terms) >= LEVEL]
    chosen = tuple(number for group in named for number in group.terms)
    unknown = table.probability_of_any(processes)
    verdict = _verdict(bool(named), unknown, table.probability_of_none)
    return ResidualDiagnosis(
        verdict=verdict,
        named=tuple(group.name for group in named),
        between=_between(table, groups) if verdict is Verdict.CANNOT_TELL else (),
        suspects=_suspects(record, likelihood, table, candidates),
        unknown=unknown,
        budget=budget(record, likelihood, table, groups, chosen, scales, rng),
        rms=record.rms,
        held_out_rms=held_out(record, [terms[i] for i in chosen], scales),
        noise=float(np.sqrt(scales.variance)),
        where=disagreements(record, likelihood),
        formula=_best_formula(record, likelihood, chosen, scales, unit) if unknown >= LEVEL else None,
        max_false_alarms=_max_false_alarms(groups),
        p_value=_p_value(record, table, surrogates, rng) if surrogates else None,
    )


def _weighed(
    record: Record, terms: list[ResidualTerm], groups: list[TermGroup]
) -> tuple[Scales, ResidualLikelihood, ModelTable]:
    """Noise scales fitted with the most probable hypothesis, and the table of hypotheses under this noise."""
    chosen: Hypothesis = ()
    for _ in range(MAX_ROUNDS):
        scales = _scales(record, [terms[i] for i in chosen])
        likelihood = ResidualLikelihood(record, terms, Noise(record.t, scales))
        table = weigh(likelihood, groups)
        if table.best == chosen:
            break
        chosen = table.best
    return scales, likelihood, table


def _scales(record: Record, beside: list[ResidualTerm]) -> Scales:
    def log_evidence(noise: Noise) -> float:
        likelihood = ResidualLikelihood(record, beside, noise)
        return likelihood.log_evidence(range(len(beside))) - 0.5 * noise.log_determinant

    return fit_noise(record.t, record.rms, log_evidence)


def _verdict(is_named: bool, unknown: float, none: float) -> Verdict:
    if is_named:
        return Verdict.EFFECT
    if unknown >= LEVEL:
        return Verdict.UNKNOWN
    return Verdict.NO_GAP if none >= MIN_PROBABILITY_NO_GAP else Verdict.CANNOT_TELL


def _between(table: ModelTable, groups: list[TermGroup]) -> tuple[str, ...]:
    """Names of few causes of which at least one acts with the probability LEVEL, chosen greedily; empty if none do."""
    names, terms, remaining = list[str](), list[int](), list(groups)
    while remaining and table.probability_of_any(terms) < LEVEL:
        best = max(remaining, key=lambda group: table.probability_of_any([*terms, *group.terms]))
        remaining.remove(best)
        names.append(best.name)
        terms += best.terms
    return tuple(names) if table.probability_of_any(terms) >= LEVEL else ()


def _suspects(
    record: Record, likelihood: ResidualLikelihood, table: ModelTable, candidates: list[TermGroup]
) -> tuple[Suspect, ...]:
    suspects = []
    for group in candidates:
        (number,) = group.terms
        alone = likelihood.gains([], [number])
        value, sd = _magnitude(likelihood, table, group)
        size = float(np.sqrt(np.mean(likelihood.terms[number].columns ** 2)))
        suspects.append(
            Suspect(
                name=group.name,
                probability=table.probability_of_any(group.terms),
                log_bayes_factor=float(alone.gain[0]),
                value=value,
                sd=sd,
                unit=record.candidates[group.name].unit,
                hidden=size * (abs(value) + ONE_SIDED_95 * sd),
            )
        )
    return tuple(sorted(suspects, key=lambda suspect: -suspect.probability))


def _magnitude(likelihood: ResidualLikelihood, table: ModelTable, group: TermGroup) -> tuple[float, float]:
    """Value and sd of a candidate's magnitude if it acts, averaged over the other terms of the hypothesis."""
    (number,) = group.terms
    log: dict[Hypothesis, float] = {}  # log probability of the other terms, up to a constant
    gains = {}
    likely = max(int(np.searchsorted(-table.probability, -MIN_PROBABILITY)), 1)  # hypotheses, most probable first
    for p, chosen in zip(table.probability[:likely].tolist(), table.hypotheses, strict=False):
        beside = tuple(other for other in chosen if other != number)
        if beside not in log:
            gains[beside] = likelihood.gains(beside, [number])
            log[beside] = float(np.log(p)) + (-group.log_prior if number in chosen else float(gains[beside].gain[0]))
    weight = np.exp(np.array(list(log.values())) - max(log.values()))
    weight /= weight.sum()
    values = np.array([gain.value[0] for gain in gains.values()])
    sds = np.array([gain.sd[0] for gain in gains.values()])
    if likelihood.priors[number].positive:
        values, sds = above_zero(values, sds)
    mean = float(weight @ values)
    return mean, float(np.sqrt(weight @ (sds**2 + (values - mean) ** 2)))


def _best_formula(
    record: Record, likelihood: ResidualLikelihood, chosen: Hypothesis, scales: Scales, unit: str
) -> Description | None:
    """The formula with most evidence beside the chosen terms; None if its log Bayes factor is not above 0."""
    variables = {name: Variable(axis.values, axis.unit) for name, axis in record.axes.items()}
    formula = best_formula(variables, unit, record.rms, lambda columns: judged(*likelihood.projected(chosen, columns)))
    if formula is None or formula.gain <= 0:
        return None
    size = record.rms / float(np.sqrt(np.mean(formula.column**2)))
    term = ResidualTerm(name=formula.text, columns=record.off_base(formula.column[:, None]), sd=size)
    return Description(
        text=formula.text,
        value=formula.value,
        sd=formula.sd,
        unit=formula.unit,
        log_bayes_factor=formula.gain,
        held_out_rms=held_out(record, [*(likelihood.terms[i] for i in chosen), term], scales),
    )


def _max_false_alarms(groups: list[TermGroup]) -> float:
    """Upper bound of the probability that noise alone gives a cause the probability LEVEL.

    Under noise the mean of the posterior odds is the prior odds, so they exceed x with a probability of at most prior
    odds / x (Markov's inequality).
    """
    odds = float(np.prod([1 + np.exp(group.log_odds) for group in groups])) - 1
    return float(odds * (1 - LEVEL) / LEVEL)


def _p_value(record: Record, table: ModelTable, surrogates: int, rng: np.random.Generator) -> float:
    """Share of records (surrogates of noise, and this one) whose odds of any cause are at least those of this one."""
    noise = Noise(record.t, _scales(record, []))
    larger = 0
    for _ in range(surrogates):
        drawn = replace(record, residual=record.off_base(noise.draw(rng)))
        larger += _weighed(drawn, *terms_of(drawn))[2].log_odds >= table.log_odds
    return (1 + larger) / (1 + surrogates)

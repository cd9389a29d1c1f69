"""Diagnosis of the residual of any model: which causes explain it, how far they reduce it, and where it is.

The residual is measurement less model, sample by sample. A candidate is a column: the residual that a cause of
magnitude 1 would leave. Nameless processes along every axis describe causes that are not candidates. One likelihood
gives the evidence of sets of causes, and their probabilities give the verdict.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from estimator.answers.diagnosis import Verdict
from estimator.blas_threads import one_blas_thread
from estimator.components.formula import Variable, best_formula, judged
from estimator.components.model_table import Cause, Chosen, ModelTable, weigh
from estimator.components.one_sided import above_zero
from estimator.errors import InputError
from estimator.residual.answer import Description, ResidualDiagnosis, Suspect
from estimator.residual.causes import Form, ResidualLikelihood, forms_of
from estimator.residual.inputs import Axis, Candidate, Record, checked, checked_unit
from estimator.residual.noise import Noise, Scales, fit_noise
from estimator.residual.places import disagreements
from estimator.residual.shares import budget, held_out
from estimator.signals import Floats

LEVEL = 0.95  # smallest probability of a cause to name it
MIN_PROBABILITY_NO_GAP = 0.5  # of no cause at all, for the verdict "no gap"
MIN_PROBABILITY = 1e-3  # of a set, to include it in the average of a magnitude
MAX_ROUNDS = 4  # of fitting the noise scales and weighing the sets in turn
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
    forms, causes = forms_of(record)
    scales, likelihood, table = _judged(record, forms, causes)
    candidates = [cause for cause in causes if cause.is_named]
    processes = [form for cause in causes if not cause.is_named for form in cause.forms]
    named = [cause for cause in candidates if table.holding(cause.forms) >= LEVEL]
    chosen = tuple(form for cause in named for form in cause.forms)
    unknown = table.holding(processes)
    verdict = _verdict(bool(named), unknown, table.none)
    return ResidualDiagnosis(
        verdict=verdict,
        named=tuple(cause.name for cause in named),
        between=_between(table, causes) if verdict is Verdict.CANNOT_TELL else (),
        suspects=_suspects(record, likelihood, table, candidates),
        unknown=unknown,
        budget=budget(record, likelihood, table, causes, chosen, scales, rng),
        rms=record.rms,
        reached=held_out(record, [forms[i] for i in chosen], scales),
        noise=float(np.sqrt(scales.variance)),
        where=disagreements(record, likelihood),
        formula=_best_formula(record, likelihood, chosen, scales, unit) if unknown >= LEVEL else None,
        max_false_alarms=_max_false_alarms(causes),
        p_value=_p_value(record, table, surrogates, rng) if surrogates else None,
    )


def _judged(record: Record, forms: list[Form], causes: list[Cause]) -> tuple[Scales, ResidualLikelihood, ModelTable]:
    """Noise scales fitted with the most probable set in the model, and the table of sets under this noise."""
    chosen: Chosen = ()
    for _ in range(MAX_ROUNDS):
        scales = _scales(record, [forms[i] for i in chosen])
        likelihood = ResidualLikelihood(record, forms, Noise(record.t, scales))
        table = weigh(likelihood, causes)
        if table.best == chosen:
            break
        chosen = table.best
    return scales, likelihood, table


def _scales(record: Record, beside: list[Form]) -> Scales:
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


def _between(table: ModelTable, causes: list[Cause]) -> tuple[str, ...]:
    """Names of few causes of which at least one acts with the probability LEVEL, chosen greedily; empty if none do."""
    names, forms, left = list[str](), list[int](), list(causes)
    while left and table.holding(forms) < LEVEL:
        best = max(left, key=lambda cause: table.holding([*forms, *cause.forms]))
        left.remove(best)
        names.append(best.name)
        forms += best.forms
    return tuple(names) if table.holding(forms) >= LEVEL else ()


def _suspects(
    record: Record, likelihood: ResidualLikelihood, table: ModelTable, candidates: list[Cause]
) -> tuple[Suspect, ...]:
    suspects = []
    for cause in candidates:
        (form,) = cause.forms
        alone = likelihood.gains([], [form])
        value, sd = _magnitude(likelihood, table, cause)
        size = float(np.sqrt(np.mean(likelihood.forms[form].columns ** 2)))
        suspects.append(
            Suspect(
                name=cause.name,
                probability=table.holding(cause.forms),
                log_bayes_factor=float(alone.gain[0]),
                value=value,
                sd=sd,
                unit=record.candidates[cause.name].unit,
                hidden=size * (abs(value) + ONE_SIDED_95 * sd),
            )
        )
    return tuple(sorted(suspects, key=lambda suspect: -suspect.probability))


def _magnitude(likelihood: ResidualLikelihood, table: ModelTable, cause: Cause) -> tuple[float, float]:
    """Value and sd of a candidate's magnitude if it acts, averaged over the other causes in the set."""
    (form,) = cause.forms
    log: dict[Chosen, float] = {}  # log probability of the other causes, up to a constant
    gains = {}
    likely = max(int(np.searchsorted(-table.probability, -MIN_PROBABILITY)), 1)  # sets, the most probable first
    for p, chosen in zip(table.probability[:likely].tolist(), table.sets, strict=False):
        beside = tuple(other for other in chosen if other != form)
        if beside not in log:
            gains[beside] = likelihood.gains(beside, [form])
            log[beside] = float(np.log(p)) + (-cause.log_prior if form in chosen else float(gains[beside].gain[0]))
    weight = np.exp(np.array(list(log.values())) - max(log.values()))
    weight /= weight.sum()
    values, sds = (
        np.array([judged_form.value[0] for judged_form in gains.values()]),
        np.array([judged_form.sd[0] for judged_form in gains.values()]),
    )
    if likelihood.priors[form].positive:
        values, sds = above_zero(values, sds)
    mean = float(weight @ values)
    return mean, float(np.sqrt(weight @ (sds**2 + (values - mean) ** 2)))


def _best_formula(
    record: Record, likelihood: ResidualLikelihood, chosen: Chosen, scales: Scales, unit: str
) -> Description | None:
    """The formula with most evidence beside the chosen forms; None if its log Bayes factor is not above 0."""
    variables = {name: Variable(axis.values, axis.unit) for name, axis in record.axes.items()}
    formula = best_formula(variables, unit, record.rms, lambda columns: judged(*likelihood.projected(chosen, columns)))
    if formula is None or formula.gain <= 0:
        return None
    size = record.rms / float(np.sqrt(np.mean(formula.column**2)))
    form = Form(cause=formula.text, columns=record.off(formula.column[:, None]), sd=size)
    reached = held_out(record, [*(likelihood.forms[i] for i in chosen), form], scales)
    return Description(
        text=formula.text,
        value=formula.value,
        sd=formula.sd,
        unit=formula.unit,
        log_bayes_factor=formula.gain,
        reached=reached,
    )


def _max_false_alarms(causes: list[Cause]) -> float:
    """Upper bound of the probability that noise alone gives a cause the probability LEVEL.

    Under noise the mean of the posterior odds is the prior odds, so they exceed x with a probability of at most prior
    odds / x (Markov's inequality).
    """
    odds = float(np.prod([1 + np.exp(cause.log_odds) for cause in causes])) - 1
    return float(odds * (1 - LEVEL) / LEVEL)


def _p_value(record: Record, table: ModelTable, surrogates: int, rng: np.random.Generator) -> float:
    """Share of records (surrogates of noise, and this one) whose odds of any cause are at least those of this one."""
    noise = Noise(record.t, _scales(record, []))
    larger = 0
    for _ in range(surrogates):
        drawn = replace(record, residual=record.off(noise.draw(rng)))
        larger += _judged(drawn, *forms_of(drawn))[2].log_odds >= table.log_odds
    return (1 + larger) / (1 + surrogates)

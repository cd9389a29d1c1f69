"""Evidence of every effect of the catalogue in the residual of the present model."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from estimator.components.switching import CHANGE_COST
from estimator.diagnosis import switching_times
from estimator.diagnosis.averaged_residual import Averages, weigh
from estimator.diagnosis.evidence import log_bayes_factor, score
from estimator.diagnosis.model import Model
from estimator.model.design_matrix import Spans, Term, inside
from estimator.model.effects import Effect, Timing
from estimator.signals import Floats, Quantity

MIN_INSTRUMENTS_LOG_BF = 5.0  # log BF by the instruments from which they confirm a noisy effect
IDLE_POWER_SD, IDLE_POWER_SHARE = 800.0, 0.15  # sd of the power at idle: [W], and share of it; torque is coarse there
MIN_LOG_BF = -50.0  # floor of the log BF, for a magnitude of the wrong sign in every shape


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """An effect with the shape and the times of most evidence."""

    term: Term
    log_bayes_factor: float
    value: float
    sd: float
    cost: float  # log prior of its times with the sign changed; already subtracted from the evidence
    trace: Floats  # (n,) instrument's column off the base, of unit length

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.term.effect.name


@dataclass(frozen=True)
class Idling:
    """Mean power [W] of the engine while the vehicle stands, and its speed [rad/s] then."""

    power: float
    engine_speed: float

    def log_bayes_factor(self, candidate: "Candidate") -> float:
        """Log Bayes factor, from the power at idle, of a candidate that takes power at rest; 0 for others."""
        effect = candidate.term.effect
        if effect.at_rest is None:
            return 0.0
        per_unit = effect.at_rest(self.engine_speed)
        sd = IDLE_POWER_SD + IDLE_POWER_SHARE * abs(self.power)
        wide = float(np.hypot(sd, candidate.sd * per_unit))
        foretold = (self.power - candidate.value * per_unit) / wide
        return float(0.5 * (self.power / sd) ** 2 - 0.5 * foretold**2 + np.log(sd / wide))


def assess(
    model: Model, averages: Averages, effects: Sequence[Effect], known: frozenset[Quantity], rest: Idling | None
) -> list[Candidate]:
    """All ``effects`` that this drive can test and the model does not have, most evidence first."""
    present = {term.effect.name for term in model.terms}
    absent = [effect for effect in effects if not effect.absorbed and effect.name not in present]
    proposals = _proposals(model, absent)
    judged = [_judge(model, averages, effect, known, proposals) for effect in absent]
    found = [candidate for candidate in judged if candidate is not None]
    if rest is not None:
        found = [replace(c, log_bayes_factor=c.log_bayes_factor + rest.log_bayes_factor(c)) for c in found]
    return sorted(found, key=lambda candidate: -candidate.log_bayes_factor)


def _proposals(model: Model, effects: Sequence[Effect]) -> dict[Timing, list[Spans]]:
    """Times at which an effect may have been on: proposed for each effect, and tried for all."""
    own, _ = model.views()
    found: dict[Timing, dict[Spans, None]] = {Timing.WINDOW: {}, Timing.SWITCHING: {}}
    for effect in effects:
        if effect.timing not in found:
            continue
        profile = effect.power(own, None)
        if max(effect.dwells) > switching_times.MIN_WINDOW:
            found[Timing.WINDOW] |= dict.fromkeys(switching_times.windows(model, profile))
        if effect.timing is Timing.SWITCHING:
            for dwell in effect.dwells:
                on = switching_times.switching(model, profile, dwell)
                # At a steady speed, one effect on and another off give the same residual (drafting and a fan).
                found[Timing.SWITCHING] |= dict.fromkeys(
                    (*on, *(switching_times.between(model, spans) for spans in on))
                )
    return {when: list(spans) for when, spans in found.items()}


def _judge(
    model: Model,
    averages: Averages,
    effect: Effect,
    known: frozenset[Quantity],
    proposals: Mapping[Timing, list[Spans]],
) -> Candidate | None:
    shapes = effect.usable_shapes(known)
    if not shapes:
        return None
    terms = [Term(effect, shape) for shape in shapes if effect.timing is Timing.ALWAYS or shape is not None]
    if effect.timing is Timing.STEP:
        terms = [Term(effect, None, spans) for spans in switching_times.steps(model)]
    both = [_judge_terms(model, averages, terms), _judge_times(model, averages, effect, proposals)]
    return max((c for c in both if c is not None), key=lambda candidate: candidate.log_bayes_factor, default=None)


def _judge_terms(model: Model, averages: Averages, terms: list[Term]) -> Candidate | None:
    """Evidence averaged over ``terms`` of one effect, which have equal prior probability; None where it is not finite.

    Evidence comes from the averaged residual, where it can be compared with that of processes. A noisy column contains
    noise of the residual itself, so its evidence counts only if the instruments confirm it.
    """
    if not terms:
        return None
    effect = terms[0].effect
    own, ring = model.views()
    z = np.column_stack([term.column(ring) for term in terms])
    usual = effect.usual(model.road_load)
    weight = weigh(averages, averages.mean(z), usual, effect.positive)
    evidence, value, sd = weight.log_bayes_factor, weight.value, weight.sd
    if effect.is_noisy:
        h = np.column_stack([term.column(own) for term in terms])
        scores = score(model.base, h, z)
        clean = np.nan_to_num(log_bayes_factor(scores, usual, effect.positive), nan=MIN_LOG_BF)
        # The evidence by instruments does not allow for a process; that of the averaged residual does.
        found = np.maximum(evidence, clean) if averages.nuisance is None else evidence
        evidence = np.where(clean >= MIN_INSTRUMENTS_LOG_BF, found, np.minimum(evidence, clean))
        value, sd = scores.value, scores.sd
    best = int(np.argmax(evidence))
    cost = CHANGE_COST if effect.timing is Timing.STEP else 0.0
    total = float(logsumexp(evidence)) - np.log(len(terms)) - cost
    if not np.isfinite(sd[best]) or not np.isfinite(total):
        return None
    # The sd includes the spread of the values over the shapes.
    share = np.exp(evidence - logsumexp(evidence))
    doubt = np.nan_to_num(share * ((value - value[best]) ** 2 + sd**2), nan=0.0)
    sd = np.where(np.arange(len(sd)) == best, np.sqrt(doubt.sum()), sd)
    return Candidate(
        term=terms[best],
        log_bayes_factor=max(total, MIN_LOG_BF),
        value=float(value[best]),
        sd=float(sd[best]),
        cost=cost,
        trace=trace(model, z[:, best]),
    )


def refined(model: Model, averages: Averages, term: Term) -> Term:
    """The term with the shape of most evidence among those between its own and the neighbours that were tried."""
    effect = term.effect
    if effect.finer is None or term.spans is not None or isinstance(term.shape, Quantity):
        return term
    _, ring = model.views()
    shapes = (term.shape, *effect.finer(term.shape))
    columns = averages.mean(np.column_stack([replace(term, shape=shape).column(ring) for shape in shapes]))
    evidence = weigh(averages, columns, effect.usual(model.road_load), effect.positive).log_bayes_factor
    return replace(term, shape=shapes[int(np.argmax(evidence))])


def _judge_times(
    model: Model, averages: Averages, effect: Effect, proposals: Mapping[Timing, list[Spans]]
) -> Candidate | None:
    """The candidate with the best of the proposed times, for an effect whose times no signal shows."""
    if effect.timing not in proposals:
        return None
    own, ring = model.views()
    profile = effect.power(own, None)
    times = proposals[Timing.WINDOW] if max(effect.dwells) > switching_times.MIN_WINDOW else []
    if effect.timing is Timing.SWITCHING:
        times = [
            *times,
            *(spans for spans in proposals[Timing.SWITCHING] if switching_times.is_usual(spans, effect.dwells)),
        ]
    if not times:
        return None
    on = np.column_stack([inside(model.samples.t, spans) for spans in times])
    cost = np.array([CHANGE_COST * switching_times.changes(model, spans) for spans in times])
    weight = weigh(averages, averages.mean(profile[:, None] * on), effect.usual(model.road_load), effect.positive)
    evidence = weight.log_bayes_factor - cost
    best = int(np.argmax(evidence))
    shape = trace(model, effect.power(ring, None) * on[:, best])
    value, sd = float(weight.value[best]), float(weight.sd[best])
    term = Term(effect, None, times[best])
    return Candidate(
        term=term,
        log_bayes_factor=max(float(evidence[best]), MIN_LOG_BF),
        value=value,
        sd=sd,
        cost=float(cost[best]),
        trace=shape,
    )


def trace(model: Model, instrument: Floats) -> Floats:
    """Part of an effect's instrument (n,) that the base model cannot fit, scaled to unit length (n,)."""
    base = model.base
    off = instrument - base.Z @ (base.inverse.T @ (base.X.T @ instrument))
    return off / max(float(np.linalg.norm(off)), np.finfo(float).tiny)

"""Every effect of the catalogue, judged on what the model so far leaves."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp

from estimator.diagnosis import timing
from estimator.diagnosis.evidence import log_bayes_factor, score
from estimator.diagnosis.model import Model
from estimator.diagnosis.processes import Grains, column_evidence
from estimator.effects import Effect, Timing
from estimator.estimation.columns import Term, inside
from estimator.signals import Floats, Quantity

ALIKE = 0.95  # |correlation| of traces beyond which two effects are one class
NEVER = -50.0  # log Bayes factor of what cannot be: a magnitude of the wrong sign in every shape


@dataclass(frozen=True)
class Candidate:
    """An effect with the shape and timing that suit it best."""

    term: Term
    log_bayes_factor: float
    value: float
    sd: float
    cost: float  # of finding its times, part of the evidence
    trace: Floats  # (n,) instrument's column off the base, of unit length

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.term.effect.name


def assess(model: Model, grains: Grains, effects: Sequence[Effect], known: frozenset[Quantity]) -> list[Candidate]:
    """All ``effects`` that this drive can test and the model does not have, most evidence first."""
    present = {term.effect.name for term in model.terms}
    absent = [effect for effect in effects if not effect.absorbed and effect.name not in present]
    judged = [_judge(model, grains, effect, known) for effect in absent]
    return sorted((c for c in judged if c is not None), key=lambda c: -c.log_bayes_factor)


def _judge(model: Model, grains: Grains, effect: Effect, known: frozenset[Quantity]) -> Candidate | None:
    shapes = effect.usable_shapes(known)
    if not shapes:
        return None
    if effect.timing is Timing.ALWAYS:
        return _judge_shapes(model, [Term(effect, shape) for shape in shapes])
    if effect.timing is Timing.STEP:
        return _judge_shapes(model, [Term(effect, None, spans) for spans in timing.steps(model)])
    signalled = _judge_shapes(model, [Term(effect, shape) for shape in shapes if shape is not None])
    timed = _judge_times(model, grains, effect)
    both = [candidate for candidate in (signalled, timed) if candidate is not None]
    return max(both, key=lambda candidate: candidate.log_bayes_factor, default=None)


def _judge_shapes(model: Model, terms: list[Term]) -> Candidate | None:
    """By instruments, averaged over shapes that are as likely as one another."""
    if not terms:
        return None
    effect = terms[0].effect
    own, ring = model.views()
    h = np.column_stack([term.column(own) for term in terms])
    z = np.column_stack([term.column(ring) for term in terms])
    scores = score(model.base, h, z)
    evidence = log_bayes_factor(scores, effect.usual(model.road_load), effect.positive)
    evidence = np.where(np.isfinite(evidence), evidence, -np.inf)
    best = int(np.argmax(evidence))
    if not np.isfinite(evidence[best]):
        return None
    total = float(logsumexp(evidence)) - np.log(len(terms))
    value, sd = float(scores.value[best]), float(scores.sd[best])
    return Candidate(terms[best], max(total, NEVER), value, sd, 0.0, trace(model, z[:, best]))


def _judge_times(model: Model, grains: Grains, effect: Effect) -> Candidate | None:
    """By the averaged residual: a proposal's own samples are too few to tell their noise."""
    own, ring = model.views()
    profile = effect.power(own, None)
    proposals = timing.windows(model, profile)
    if effect.timing is Timing.SWITCHING:
        proposals += timing.switching(model, profile)
    best = None
    for spans in proposals:
        on = inside(model.samples.t, spans)
        column = grains.mean(profile * on)
        weight = column_evidence(grains, column, effect.usual(model.road_load), effect.positive)
        cost = timing.CHANGE_COST * timing.changes(model, spans)
        evidence = weight.log_bayes_factor - cost
        if best is None or evidence > best.log_bayes_factor:
            shape = trace(model, effect.power(ring, None) * on)
            best = Candidate(Term(effect, None, spans), max(evidence, NEVER), weight.value, weight.sd, cost, shape)
    return best


def trace(model: Model, instrument: Floats) -> Floats:
    """What an effect leaves once the base is refitted: its instrument off the base (n,), of unit length."""
    base = model.base
    off = instrument - base.Z @ (base.inverse.T @ (base.X.T @ instrument))
    return off / max(float(np.linalg.norm(off)), np.finfo(float).tiny)

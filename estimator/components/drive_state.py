"""Fit road and noise of one drive beside the terms that are chosen so far."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import logsumexp

from estimator.components.likelihood import JointLikelihood
from estimator.components.one_sided import log_evidence_of_sign
from estimator.components.set_likelihood import TermGains
from estimator.components.switching import Switching
from estimator.components.term import Frame, Term, as_effect_terms, term_of, untimed_terms
from estimator.estimation.road_fit import RoadFit, fit, fit_given, refit
from estimator.estimation.road_likelihood import LAG
from estimator.estimation.savage_dickey import log_bayes_factor, posterior_of
from estimator.estimation.scales import RoadScales
from estimator.estimation.shapes import with_nearer_shapes
from estimator.model.conditioned import Conditioned
from estimator.model.effect_term import EffectTerm
from estimator.model.effects.effect import AtRest, Effect, Timing
from estimator.model.road import LEVEL
from estimator.model.road_scales import POWER, SCALES, TORQUE
from estimator.signals import Floats
from estimator.strides import Strides
from estimator.units import STANDARD_GRAVITY

# Prior sd (2,) of the logarithms of the slow noise of torque and power.
_SPREADS = np.array([np.hypot(SCALES[i].spread, 0.5 * SCALES[i + 1].spread) for i in (TORQUE, POWER)])


@dataclass(frozen=True, kw_only=True)
class FittedTerm:
    """Term of an effect with most evidence on one drive.

    ``gain``: log Bayes factor, less the costs, averaged over the terms of the effect that need no fitted times.
    ``value`` and ``sd`` of its magnitude.
    """

    term: Term
    gain: float
    value: float
    sd: float
    trace: Floats  # (n,) its column [m/s^2]


@dataclass(frozen=True, kw_only=True)
class DriveState:
    """One drive: the terms chosen so far, and the fit of the road with them.

    ``rests``: power at standstill, where it is known. ``stretches`` of the road that are steeper than its Gaussian
    process allows.
    """

    strides: Strides
    fit: RoadFit
    rests: tuple[AtRest, ...] = ()
    chosen: tuple[Term, ...] = ()
    stretches: Term | None = None

    @property
    def is_level(self) -> bool:
        """True if the model of the road has no slopes."""
        return self.fit.scales.alpha == LEVEL

    @property
    def is_road_hidden(self) -> bool:
        """True if the road has slopes and no signal shows them."""
        return not (self.is_level or self.fit.scales.readings)

    @property
    def slope_sd(self) -> float:
        """Standard deviation of the road's slope [1], its stretches included."""
        if self.stretches is None:
            return self.fit.slope_sd
        joint = self.joint
        slopes = joint.posterior(range(len(self.chosen))).mean[joint.stretches]
        steep = self.stretches.columns(joint.frame) @ slopes / STANDARD_GRAVITY
        return float(np.hypot(self.fit.slope_sd, steep.std()))

    @classmethod
    def of(
        cls, strides: Strides, rests: tuple[AtRest, ...] = (), is_level: bool = False, scales: RoadScales | None = None
    ) -> "DriveState | None":
        """Drive without chosen terms; None if no fit is possible or its 1/m is not positive.

        ``scales``: scales of an earlier fit to start from.
        """
        fitted = fit(strides, (), scales, level=is_level, rests=rests)
        if fitted is None or not fitted.beta[0] > 0:
            return None
        return cls(strides=strides, fit=fitted, rests=rests)

    def with_terms(
        self,
        chosen: tuple[Term, ...],
        processes: tuple[Term, ...] = (),
        stretches: Term | None = None,
    ) -> "DriveState":
        """Copy with other ``chosen`` effects and ``stretches`` of the road, its scales of road and noise refitted.

        Nameless ``processes`` are in this fit too, but not among the chosen terms.
        """
        frame, further = Frame.of(self.fit), (*processes, *(() if stretches is None else (stretches,)))
        effect_terms = [replace(term.effect_term, usual_sds=1.0) for term in chosen if term.effect_term is not None]
        effect_terms += [effect_term for process in further for effect_term in as_effect_terms(frame, process)]
        fitted = refit(self.fit, self.strides, effect_terms, self.rests)
        return replace(self, fit=fitted, chosen=chosen, stretches=stretches)

    def with_nearer_shapes(self, given: int) -> "DriveState":
        """Copy whose chosen effects have the shapes near theirs with most evidence; the first ``given`` keep theirs."""
        fitted = with_nearer_shapes(
            self.strides, self.fit, lambda found, terms: refit(found, self.strides, terms, self.rests), given
        )
        frame = Frame.of(fitted)
        chosen = tuple(
            term_of(frame, replace(old.effect_term, shape=new.shape), old.cost) if old.effect_term else old
            for old, new in zip(self.chosen, fitted.terms, strict=False)
        )
        return replace(self, fit=fitted, chosen=chosen)

    def bare(self) -> "DriveState":
        """Copy without the model and the likelihood, which a drive keeps once they are asked for."""
        return replace(self)

    @property
    def magnitudes(self) -> Floats:
        """Magnitudes (c,) of the chosen effects, each in its own unit."""
        return self.fit.theta[LAG + 1 : LAG + 1 + len(self.chosen)]

    @property
    def log_evidence(self) -> float:
        """Log evidence of the drive with the chosen effects, under the priors they have in every hypothesis."""
        sds = np.sqrt(np.diag(self.fit.theta_covariance()))[LAG + 1 : LAG + 1 + len(self.chosen)]
        positive = np.array([term.positive for term in self.chosen], dtype=np.bool_)
        signs = log_evidence_of_sign(self.magnitudes / sds)[positive]
        return self.fit.log_evidence + float(signs.sum())

    @property
    def has_unusual_noise(self) -> bool:
        """True if slow noise of torque or power exceeds its prior centre by one prior sd: it may hide effects."""
        usual = _slow_noise(np.array([scale.centre for scale in SCALES]))
        return bool(np.any(np.log(_slow_noise(self.fit.scales.values) / usual) > _SPREADS))

    def with_usual_noise(self) -> "DriveState":
        """Copy with noise sd and correlation time of torque and power capped at the centres of their priors."""
        values = self.fit.scales.values.copy()
        for i in (TORQUE, TORQUE + 1, POWER, POWER + 1):
            values[i] = min(values[i], SCALES[i].centre)
        scales = replace(self.fit.scales, values=values)
        fitted = fit_given(self.strides, scales, self.fit.terms, rests=self.rests)
        return self if fitted is None else replace(self, fit=fitted)

    def beyond_limits(self, given: int) -> set[str]:
        """Names of effects after the first ``given`` ones that are beyond their limits for the fitted road load."""
        chosen = zip(self.chosen[given:], self.magnitudes[given:].tolist(), strict=True)
        effects = [(term.effect_term.effect, size) for term, size in chosen if term.effect_term is not None]
        load = Frame.of(self.fit).road_load
        return {
            effect.name for effect, size in effects if abs(size) > effect.limit(load) or size > effect.max_positive_size
        }

    def nearest_to_mass(self, given: int) -> set[str]:
        """Name of the effect after the first ``given`` ones whose magnitude is most correlated with 1/m; or none."""
        covariance = self.fit.covariance
        first = len(covariance) - len(self.fit.terms) + given
        shared = {
            term.name: abs(covariance[0, first + i]) / np.sqrt(covariance[first + i, first + i])
            for i, term in enumerate(self.chosen[given:])
        }
        return {max(shared, key=lambda name: float(shared[name]))} if shared else set()

    @cached_property
    def _conditioned(self) -> Conditioned:
        return Conditioned.of(self.fit.scales.model_of(self.strides), self.fit.scales.values)

    @cached_property
    def joint(self) -> JointLikelihood:
        """Likelihood of the chosen terms; the stretches are in every hypothesis."""
        return self.joint_with(())

    def joint_with(self, candidates: Sequence[Term]) -> JointLikelihood:
        """Likelihood of the chosen terms followed by ``candidates``; the stretches are in every hypothesis."""
        return self.likelihood_of([*self.chosen, *candidates], self.stretches)

    def likelihood_of(self, terms: Sequence[Term], stretches: Term | None = None) -> JointLikelihood:
        """Likelihood of any ``terms`` with the power at standstill; ``stretches`` are in every hypothesis."""
        joint = JointLikelihood(self._conditioned, self.fit, terms, stretches)
        for rest in self.rests:
            effect_terms = {i: term.effect_term for i, term in enumerate(terms) if term.effect_term is not None}
            per_unit = {i: effect_term.at_rest(rest) for i, effect_term in effect_terms.items()}
            weights = {i: power / rest.sd for i, power in per_unit.items() if power}
            joint.observe(weights, rest.power / rest.sd)
        return joint

    def fitted_terms(self, effects: Sequence[Effect]) -> dict[str, FittedTerm]:
        """Term with most evidence of each of ``effects`` that is not chosen and that this drive can test, by name."""
        quantities, frame = frozenset(self.strides.context), Frame.of(self.fit)
        present = {term.name for term in self.chosen}
        absent = [effect for effect in effects if effect.name not in present]
        untimed = [term for effect in absent for term in untimed_terms(frame, effect, quantities)]
        joint, chosen = self.joint, list(range(len(self.chosen)))
        gains = self.joint_with(untimed).gains(chosen, range(len(chosen), len(chosen) + len(untimed)))
        switching, best_terms = Switching(joint), dict[str, FittedTerm]()
        for effect in absent:
            numbers = [i for i, term in enumerate(untimed) if term.name == effect.name]
            if numbers:
                best_terms[effect.name] = _best(frame, untimed, gains, numbers)
            timed = _with_fitted_times(switching, joint, chosen, effect) if has_free_times(effect) else None
            if timed is not None and (effect.name not in best_terms or timed.gain > best_terms[effect.name].gain):
                best_terms[effect.name] = timed
        return best_terms


def _slow_noise(scales: Floats) -> Floats:
    """Slow noise (2,) [m/s^1.5] of torque and power: sd times the square root of the correlation time.

    It is proportional to the root of the spectral density at the low frequencies of effects.
    """
    return np.array([scales[i] * np.sqrt(scales[i + 1]) for i in (TORQUE, POWER)])


def has_free_times(effect: Effect) -> bool:
    """True if no signal shows when the effect acts, so that its times are fitted."""
    return effect.timing in (Timing.WINDOW, Timing.SWITCHING) and None in effect.shapes


def _with_fitted_times(
    switching: Switching, joint: JointLikelihood, chosen: list[int], effect: Effect
) -> FittedTerm | None:
    """Term of ``effect`` with fitted times, beside the ``chosen`` ones; None if no times gain evidence."""
    times = switching.best(chosen, effect)
    if times is None:
        return None
    term = term_of(joint.frame, EffectTerm(effect, None, times[0]), times[1])
    column = term.columns(joint.frame)
    products, score = joint.projected(chosen, column)
    value, sd = map(float, posterior_of(score[0], products[0, 0], term.sd))
    gain = log_bayes_factor(value, sd, term.sd)
    gain += log_evidence_of_sign(value / sd) if term.positive else 0.0
    return FittedTerm(term=term, gain=float(gain) - term.cost, value=value, sd=sd, trace=column[:, 0])


def _best(frame: Frame, terms: Sequence[Term], gains: TermGains, numbers: Sequence[int]) -> FittedTerm:
    """Term with most evidence among those with ``numbers``.

    Its gain is the mean of the Bayes factors of all of them, which have equal prior probability.
    """
    net_gains = gains.gain[list(numbers)] - np.array([terms[i].cost for i in numbers])
    best = numbers[int(np.argmax(net_gains))]
    gain = float(logsumexp(net_gains)) - np.log(len(numbers))
    column = terms[best].columns(frame)[:, 0]
    return FittedTerm(
        term=terms[best], gain=gain, value=float(gains.value[best]), sd=float(gains.sd[best]), trace=column
    )

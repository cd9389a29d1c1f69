"""One drive, the components chosen for it so far, and the fit of road and noise beside them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import logsumexp

from estimator.components.component import Component, Frame, as_terms, of_effect, of_term
from estimator.components.likelihood import JointLikelihood
from estimator.components.one_sided import log_evidence_of_sign
from estimator.components.set_likelihood import Judged
from estimator.components.switching import Switching
from estimator.estimation.road_fit import PROBE_SEED, RoadFit, fit, fit_given, refit
from estimator.estimation.road_likelihood import LAG
from estimator.estimation.road_search import RoadScales
from estimator.model.conditioned import Conditioned
from estimator.model.effects.effect import AtRest, Effect, Timing
from estimator.model.road import LEVEL
from estimator.model.road_scales import POWER, SCALES, TORQUE
from estimator.model.term import Term
from estimator.signals import Floats
from estimator.strides import Strides
from estimator.units import STANDARD_GRAVITY

# Of the logarithms of the slow noise of torque and power, by the priors of their scales.
_SPREADS = np.array([np.hypot(SCALES[i].spread, 0.5 * SCALES[i + 1].spread) for i in (TORQUE, POWER)])


@dataclass(frozen=True, kw_only=True)
class Form:
    """The best form of an effect on one drive: gain in log evidence, costs and all forms counted; value and sd."""

    component: Component
    gain: float
    value: float
    sd: float
    trace: Floats  # (n,) its column


@dataclass(frozen=True, kw_only=True)
class DriveState:
    """One drive, the components chosen for it so far, and the fit of the road beside them.

    ``rests``: the power while the vehicle stood, as far as it is known. ``stretches`` of the road that are steeper than
    its process has them.
    """

    strides: Strides
    fit: RoadFit
    rests: tuple[AtRest, ...] = ()
    chosen: tuple[Component, ...] = ()
    stretches: Component | None = None

    @property
    def is_level(self) -> bool:
        """Whether the road has no slopes."""
        return self.fit.scales.alpha == LEVEL

    @property
    def is_hidden(self) -> bool:
        """Whether the road has slopes that no signal shows."""
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
        cls, strides: Strides, rests: tuple[AtRest, ...] = (), is_level: bool = False, known: RoadScales | None = None
    ) -> "DriveState | None":
        """The plain start, from scales ``known`` before; None where too little is known."""
        found = fit(strides, np.random.default_rng(PROBE_SEED), (), known, level=is_level, rests=rests)
        if found is None or not found.beta[0] > 0:
            return None
        return cls(strides=strides, fit=found, rests=rests)

    def having(
        self,
        chosen: tuple[Component, ...],
        processes: tuple[Component, ...] = (),
        stretches: Component | None = None,
    ) -> "DriveState":
        """With other effects and ``stretches`` of the road; scales of road and noise are found again beside them.

        Beside nameless ``processes`` too.
        """
        frame, further = Frame.of(self.fit), (*processes, *(() if stretches is None else (stretches,)))
        terms = [replace(component.term, usual_sds=1.0) for component in chosen if component.term is not None]
        terms += [term for process in further for term in as_terms(frame, process)]
        found = refit(self.fit, self.strides, np.random.default_rng(PROBE_SEED), terms, self.rests)
        return replace(self, fit=found, chosen=chosen, stretches=stretches)

    @property
    def sizes(self) -> Floats:
        """Magnitudes (c,) of the effects chosen, each in its own unit."""
        return self.fit.theta[LAG + 1 : LAG + 1 + len(self.chosen)]

    @property
    def log_evidence(self) -> float:
        """Of the drive beside the effects chosen, with the priors that these have in every set of a table."""
        sds = np.sqrt(np.diag(self.fit.theta_covariance()))[LAG + 1 : LAG + 1 + len(self.chosen)]
        positive = np.array([component.positive for component in self.chosen], dtype=np.bool_)
        signs = log_evidence_of_sign(self.sizes / sds)[positive]
        return self.fit.log_evidence + float(signs.sum())

    @property
    def has_unusual_noise(self) -> bool:
        """Whether slow noise of torque or power is larger than usual: effects that were not found may be in it."""
        usual = slow_noise(np.array([scale.centre for scale in SCALES]))
        return bool(np.any(np.log(slow_noise(self.fit.scales.values) / usual) > _SPREADS))

    def with_usual_noise(self) -> "DriveState":
        """With no more noise of torque and power, and for no longer, than usual."""
        values = self.fit.scales.values.copy()
        for i in (TORQUE, TORQUE + 1, POWER, POWER + 1):
            values[i] = min(values[i], SCALES[i].centre)
        known = replace(self.fit.scales, values=values)
        rng, terms = np.random.default_rng(PROBE_SEED), self.fit.terms
        found = fit_given(self.strides, rng, known, terms, rests=self.rests)
        return self if found is None else replace(self, fit=found)

    def is_possible(self, given: int) -> bool:
        """Whether no effect behind the first ``given`` ones is larger than it can be on the vehicle as it is found."""
        own = zip(self.chosen[given:], self.sizes[given:].tolist(), strict=True)
        effects = [(c.term.effect, size) for c, size in own if c.term is not None]
        load = Frame.of(self.fit).road_load
        return all(abs(size) <= effect.limit(load) and size <= effect.highest for effect, size in effects)

    @cached_property
    def _conditioned(self) -> Conditioned:
        return Conditioned.of(self.fit.scales.model_of(self.strides), self.fit.scales.values)

    @cached_property
    def joint(self) -> JointLikelihood:
        """The likelihood of those chosen; stretches are in every set."""
        return self.joint_with(())

    def joint_with(self, candidates: Sequence[Component]) -> JointLikelihood:
        """The same, with ``candidates`` after those chosen."""
        return self.likelihood_of([*self.chosen, *candidates], self.stretches)

    def likelihood_of(self, components: Sequence[Component], stretches: Component | None = None) -> JointLikelihood:
        """The likelihood of any ``components``; ``stretches`` are in every set."""
        rng = np.random.default_rng(PROBE_SEED)
        joint = JointLikelihood(self._conditioned, self.fit, components, rng, stretches)
        for rest in self.rests:
            terms = {i: one.term for i, one in enumerate(components) if one.term is not None}
            per_unit = {i: term.at_rest(rest) for i, term in terms.items()}
            weights = {i: power / rest.sd for i, power in per_unit.items() if power}
            joint.observe(weights, rest.power / rest.sd)
        return joint

    def forms(self, effects: Sequence[Effect]) -> dict[str, Form]:
        """The best form of each of ``effects`` that this drive can test and that is not chosen."""
        known, frame = frozenset(self.strides.context), Frame.of(self.fit)
        present = {component.name for component in self.chosen}
        absent = [effect for effect in effects if effect.name not in present]
        given = [component for effect in absent for component in of_effect(frame, effect, known)]
        joint, ours = self.joint_with(given), list(range(len(self.chosen)))
        places = range(len(ours), len(ours) + len(given))
        judged = joint.gains(ours, places)
        switching, found = Switching(joint), dict[str, Form]()
        for effect in absent:
            alike = [i for i, component in enumerate(given) if component.name == effect.name]
            if alike:
                found[effect.name] = _best(frame, given, judged, alike)
            timed = _timed(switching, joint, ours, effect) if has_free_times(effect) else None
            if timed is not None and (effect.name not in found or timed.gain > found[effect.name].gain):
                found[effect.name] = timed
        return found


def slow_noise(scales: Floats) -> Floats:
    """Square root of the spectral density [m/s^1.5] of noise of torque and power (2,) over times that effects last."""
    return np.array([scales[i] * np.sqrt(scales[i + 1]) for i in (TORQUE, POWER)])


def has_free_times(effect: Effect) -> bool:
    """Whether no signal shows when it acts, so that its times are fitted."""
    return effect.timing in (Timing.WINDOW, Timing.SWITCHING) and None in effect.shapes


def _timed(switching: Switching, joint: JointLikelihood, ours: list[int], effect: Effect) -> Form | None:
    """The form with fitted times."""
    times = switching.best(ours, effect)
    if times is None:
        return None
    component = of_term(joint.frame, Term(effect, None, times[0]), times[1])
    column = component.columns(joint.frame)
    products, score = joint.projected(ours, column)
    precision = max(float(products[0, 0]), 0.0) + component.sd**-2.0
    value, sd = float(score[0]) / precision, precision**-0.5
    gain = 0.5 * (value / sd) ** 2 - np.log(component.sd / sd)
    gain += log_evidence_of_sign(value / sd) if component.positive else 0.0
    return Form(
        component=component,
        gain=float(gain) - component.cost,
        value=value,
        sd=sd,
        trace=column[:, 0],
    )


def _best(frame: Frame, given: Sequence[Component], judged: Judged, places: Sequence[int]) -> Form:
    """The form of most evidence, averaged over forms of equal prior probability."""
    gains = judged.gain[list(places)] - np.array([given[i].cost for i in places])
    best = places[int(np.argmax(gains))]
    gain = float(logsumexp(gains)) - np.log(len(places))
    column = given[best].columns(frame)[:, 0]
    return Form(
        component=given[best], gain=gain, value=float(judged.value[best]), sd=float(judged.sd[best]), trace=column
    )

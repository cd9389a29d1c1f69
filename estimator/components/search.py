"""Which components act: the effect with most evidence first, each judged beside the road and those before.

A form's evidence is averaged over the forms of its effect that the drive allows. An effect of the vehicle has to hold
in all drives, so its evidence adds up; an event may be in one drive only.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import logsumexp

from estimator.components.component import Component, Frame, of_effect, of_term, processes
from estimator.components.likelihood import JointLikelihood
from estimator.components.set_likelihood import Judged
from estimator.components.switching import best_times
from estimator.estimation.road_fit import RoadFit, fit
from estimator.model.design_matrix import Term
from estimator.model.effects.effect import Effect, Timing
from estimator.signals import Floats
from estimator.strides import Strides

MAX_EFFECTS = 4  # effects that are looked for
PROBE_SEED = 20_042  # of the simulated noise in the corrections


@dataclass(frozen=True)
class AtRest:
    """Power [W] of the engine while the vehicle stands, its sd, and the engine's speed [rad/s] then."""

    power: float
    sd: float
    engine_speed: float


@dataclass(frozen=True, kw_only=True)
class Form:
    """The best form of an effect on one drive: gain in log evidence, costs and all forms counted; value and sd."""

    component: Component
    gain: float
    value: float
    sd: float
    trace: Floats  # (n,) its column


@dataclass(frozen=True)
class DriveState:
    """One drive, the components chosen for it so far, and the fit of the road beside them; ``rest`` None: unknown."""

    strides: Strides
    fit: RoadFit
    rest: AtRest | None
    chosen: tuple[Component, ...] = ()

    @classmethod
    def of(cls, strides: Strides, rest: AtRest | None) -> "DriveState | None":
        """The plain start; None where too little is known."""
        found = fit(strides, np.random.default_rng(PROBE_SEED))
        return None if found is None or not found.beta[0] > 0 else cls(strides, found, rest)

    def having(self, chosen: tuple[Component, ...]) -> "DriveState":
        """With other components; scales of road and noise are found again beside them."""
        terms = tuple(component.term for component in chosen if component.term is not None)
        rng = np.random.default_rng(PROBE_SEED)
        found = fit(self.strides, rng, terms, self.fit.scales, orders=False)
        return self if found is None else replace(self, fit=found, chosen=chosen)

    def joint(self, candidates: Sequence[Component] = ()) -> JointLikelihood:
        """The likelihood of those chosen, which come first, and of ``candidates``."""
        components = [*self.chosen, *candidates]
        joint = JointLikelihood(self.strides, self.fit, components, np.random.default_rng(PROBE_SEED))
        if self.rest is not None:
            per_unit = {i: at_rest(component, self.rest) for i, component in enumerate(components)}
            takers = [i for i, power in per_unit.items() if power]
            chosen = [i for i in takers if i < len(self.chosen)]
            for i in chosen[:1] or takers:  # one measurement of the power at rest: it goes to one component
                joint.observe(i, per_unit[i] / self.rest.sd, self.rest.power / self.rest.sd)
        return joint

    def forms(self, effects: Sequence[Effect]) -> dict[str, Form]:
        """The best form of each of ``effects`` that this drive can test and that is not chosen."""
        known, frame = frozenset(self.strides.context), Frame.of(self.fit)
        present = {component.name for component in self.chosen}
        absent = [effect for effect in effects if effect.name not in present]
        given = [component for effect in absent for component in of_effect(frame, effect, known)]
        joint, ours = self.joint(given), list(range(len(self.chosen)))
        places = range(len(ours), len(ours) + len(given))
        judged = joint.gains(ours, places)
        found: dict[str, Form] = {}
        for effect in absent:
            alike = [i for i, component in enumerate(given) if component.name == effect.name]
            if alike:
                found[effect.name] = _best(frame, given, judged, alike)
            timed = self._timed(joint, ours, effect)
            if timed is not None and (effect.name not in found or timed.gain > found[effect.name].gain):
                found[effect.name] = timed
        return found

    def _timed(self, joint: JointLikelihood, ours: list[int], effect: Effect) -> Form | None:
        """The form with fitted times; None beside a chosen effect that switches, whose timing errors it would fit."""
        if effect.timing not in (Timing.WINDOW, Timing.SWITCHING) or None not in effect.shapes:
            return None
        if any(c.term is not None and c.term.effect.timing is Timing.SWITCHING for c in self.chosen):
            return None
        times = best_times(joint, ours, Term(effect), effect.timing is Timing.WINDOW)
        if times is None:
            return None
        component = of_term(joint.frame, Term(effect, None, times[0]), times[1])
        column = component.columns(joint.frame)
        products, score = joint.projected(ours, column)
        precision = float(products[0, 0]) + component.sd**-2.0
        gain = 0.5 * float(score[0]) ** 2 / precision - 0.5 * np.log(precision * component.sd**2)
        return Form(
            component=component,
            gain=float(gain) - component.cost,
            value=float(score[0]) / precision,
            sd=precision**-0.5,
            trace=column[:, 0],
        )

    def unnamed(self) -> tuple[Component, float] | None:
        """The nameless process with most evidence beside those chosen, and its gain over all its forms."""
        named = list(processes(Frame.of(self.fit)))
        joint, ours = self.joint(named), list(range(len(self.chosen)))
        none = joint.log_evidence(ours)
        gains = [joint.log_evidence([*ours, i]) - none for i in range(len(ours), len(ours) + len(named))]
        best: tuple[Component, float] | None = None
        for name in dict.fromkeys(component.name for component in named):
            own = [i for i, component in enumerate(named) if component.name == name]
            gain = float(logsumexp([gains[i] for i in own])) - np.log(len(own))
            if best is None or gain > best[1]:
                best = named[max(own, key=lambda i: gains[i])], gain
        return best


def at_rest(component: Component, rest: AtRest) -> float:
    """Power [W] per unit of magnitude that it takes at rest."""
    effect = None if component.term is None else component.term.effect
    return 0.0 if effect is None or effect.at_rest is None else effect.at_rest(rest.engine_speed)


def _best(frame: Frame, given: Sequence[Component], judged: Judged, places: Sequence[int]) -> Form:
    """The form of most evidence, averaged over forms of equal prior probability."""
    gains = judged.gain[list(places)] - np.array([given[i].cost for i in places])
    best = places[int(np.argmax(gains))]
    gain = float(logsumexp(gains)) - np.log(len(places))
    column = given[best].columns(frame)[:, 0]
    return Form(
        component=given[best], gain=gain, value=float(judged.value[best]), sd=float(judged.sd[best]), trace=column
    )


@dataclass(frozen=True)
class Ranked:
    """An effect over all drives; its form on each, None where it cannot be tested."""

    effect: Effect
    each: tuple[Form | None, ...]

    @property
    def name(self) -> str:
        """Of the effect."""
        return self.effect.name

    @property
    def is_event(self) -> bool:
        """Whether it may act on one drive and not on another."""
        return self.effect.timing is not Timing.ALWAYS

    @property
    def is_timed(self) -> bool:
        """Whether its switching times are fitted."""
        term = self.best[1].component.term
        return term is not None and term.spans is not None

    @property
    def gain(self) -> float:
        """In log evidence of all drives together."""
        gains = [form.gain for form in self.each if form is not None]
        return max(gains) if self.is_event else sum(gains)

    @property
    def best(self) -> tuple[int, Form]:
        """Number of the drive with most evidence, and the form there."""
        found = [(i, form) for i, form in enumerate(self.each) if form is not None]
        return max(found, key=lambda pair: pair[1].gain)


@dataclass(frozen=True)
class Choice:
    """An effect that was chosen, and the ranking it was chosen from."""

    ranked: Ranked
    ranking: tuple[Ranked, ...]


@dataclass(frozen=True)
class Explained:
    """The drives with what was chosen, the choices in order, and the last ranking, which none was chosen from."""

    drives: tuple[DriveState, ...]
    choices: tuple[Choice, ...]
    ranking: tuple[Ranked, ...]


def ranked(drives: Sequence[DriveState], effects: Sequence[Effect]) -> tuple[Ranked, ...]:
    """All effects that some drive can test and that are not chosen, most evidence first."""
    each = [drive.forms(effects) for drive in drives]
    joined = [Ranked(effect, tuple(found.get(effect.name) for found in each)) for effect in effects]
    return tuple(sorted((one for one in joined if any(one.each)), key=lambda one: -one.gain))


def search(drives: Sequence[DriveState], effects: Sequence[Effect], needed: Mapping[bool, float]) -> Explained:
    """Add effects as long as one gains more in log evidence than is ``needed``, by whether its times are free."""
    states, choices = tuple(drives), list[Choice]()
    order = ranked(states, effects)
    while len(choices) < MAX_EFFECTS:
        best = next((one for one in order if one.gain >= needed[one.is_timed]), None)
        if best is None:
            break
        choices.append(Choice(best, order))
        states = tuple(
            drive
            if form is None or (best.is_event and form.gain < needed[best.is_timed])
            else drive.having((*drive.chosen, form.component))
            for drive, form in zip(states, best.each, strict=True)
        )
        order = ranked(states, effects)
    return Explained(states, tuple(choices), order)

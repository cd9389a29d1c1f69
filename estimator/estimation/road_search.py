"""The search for the most probable scales of road and noise, among all orders, designs and turns of the road.

Scales of one order are found by Newton's method (`scale_search`). Orders are compared by their log evidence, and those
that simple drives have need less of it: every further one has its price.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from estimator.estimation.road_likelihood import LAG, ROAD_LOAD, Likelihood, columns, taken_by
from estimator.estimation.scale_search import most_probable
from estimator.estimation.scales import RoadScales
from estimator.model.effect_term import EffectTerm
from estimator.model.linear_gaussian import NotPositiveDefiniteError
from estimator.model.road import ALPHAS, LEVEL, ROUGH, SMOOTH, RoadModel
from estimator.model.road_nodes import Place
from estimator.model.road_scales import POWER, SCALES, SLOPE, TORQUE, OperatingPoint
from estimator.signals import Floats
from estimator.strides import LAGS, Strides
from estimator.units import STANDARD_GRAVITY

TRIED_TURNS = 3  # slow places where the slope bends most, for each one that is found: bounds the cost
CLEAR = 5.0  # log evidence by which scales of other orders are clearly less probable: how much less is of no interest
MIN_ROLLING, MIN_DRAG = 0.002, 2e-5  # coefficient of rolling [1] and C over mass [1/m], below those of any vehicle
PASSES = 2  # of the coefficients, given the scales, that effects scale with
INERTIA_PASSES = 6  # where one is an inertia: of half the mass of the vehicle, 0.3 % of it are left
LAG_SPACING = float(LAGS[1] - LAGS[0])  # s


def first_guess(strides: Strides) -> Floats:
    """Rough [A, C, m] (3,) by least squares of the acceleration, to scale priors with."""
    X = columns(strides, len(LAGS) // 2, (), np.array([1e3, 1.0, 1e4]))[:, :ROAD_LOAD]
    unit = np.sqrt(np.mean(X**2, axis=0))
    beta = np.linalg.lstsq(X / unit, strides.a, rcond=None)[0] / unit
    return scaled_by(beta)


def scaled_by(beta: Floats) -> Floats:
    """[A, C, m] (3,) that effects and priors scale with, from coefficients [1/m, A/m, C/m ...] (p,).

    Over hidden hills, or in a part of a drive, A and C may come out below those of any vehicle.
    """
    m = 1 / float(np.clip(beta[0], 1e-6, 5e-3))
    return np.array([max(beta[1], MIN_ROLLING * STANDARD_GRAVITY), max(beta[2], MIN_DRAG), 1.0]) * m


_Key = tuple[OperatingPoint | None, int, int, bool, bool, tuple[Place, ...]]  # what a model depends on


class Search:
    """The search for the scales, the smoothness of the road and the nearest of LAGS."""

    def __init__(
        self,
        strides: Strides,
        terms: Sequence[EffectTerm],
        road_load: Floats,
        longest_lag: float = float(LAGS.max()),
        departures: Sequence[float] = (),
        taken: Floats | float = 0.0,
    ) -> None:
        self._strides, self._terms, self._road_load, self._longest_lag = strides, terms, road_load, longest_lag
        self._departures, self._taken = departures, taken
        self._models: dict[_Key, RoadModel] = {}
        self._known: RoadScales | None = None  # of the search before
        self._lost: list[RoadScales] = []

    @cached_property
    def point(self) -> OperatingPoint | None:
        """Point of the strides, that new scales are found at; None where no engine speed is known."""
        driven = self._strides[self._strides.known]
        return OperatingPoint.of(driven) if np.isfinite(driven.gearing * driven.speed).any() else None

    def model(self, scales: RoadScales) -> RoadModel:
        """The strides' model that belongs to scales; kept."""
        key = self._key(scales)
        if key not in self._models:
            self._models[key] = self._model_like(scales)
        return self._models[key]

    @staticmethod
    def _key(scales: RoadScales) -> "_Key":
        return (scales.point, *scales.orders, scales.turns)

    def _model_like(self, scales: RoadScales) -> RoadModel:
        """A model that belongs to scales; one that is kept and differs in the road's design alone lends the rest."""
        *shared, _, _ = self._key(scales)
        base = next((model for (*others, _, _), model in self._models.items() if others == shared), None)
        return scales.model_of(self._strides) if base is None else base.laid(scales.designed, scales.turns)

    def likelihood(self, scales: RoadScales) -> Likelihood:
        """The likelihood that belongs to scales."""
        return self._likelihood_of(self.model(scales), scales)

    def _likelihood_of(self, model: RoadModel, scales: RoadScales) -> Likelihood:
        return Likelihood(model, self._terms, self._road_load, scales.lag, self._departures, self._taken)

    def given(self, scales: RoadScales) -> tuple[Likelihood, RoadScales, float]:
        """Likelihood and log evidence at the given ``scales``; effects scale with the road load fitted there."""
        likelihood = self._settled(scales, PASSES if self._terms else 0)
        return likelihood, scales, likelihood.log_evidence(scales.values) - scales.price

    def improved(self, known: RoadScales) -> tuple[Likelihood, RoadScales, float]:
        """The most probable scales from those ``known``, of the same orders; their likelihood and log evidence."""
        scales, evidence = self._lagged(known)
        return self._settled(scales), scales, evidence

    def best(self, known: RoadScales | None, level: bool) -> tuple[Likelihood, RoadScales, float]:
        """Most probable scales and orders, their likelihood and log evidence, from ``known`` or the prior centres."""
        self._known = known
        try:
            scales, evidence = self._lagged(known or self.central(level))
        except NotPositiveDefiniteError:  # scales of another part of the drive
            if known is None:
                raise
            scales, evidence = self._lagged(self.central(level))
        scales, evidence, lead = self._better(scales, evidence, _other_noise(scales))
        chance = 0.0 if scales.has_power else 0.5 * (1 - float(np.tanh(0.5 * lead)))
        scales = replace(scales, power_chance=chance)
        if scales.readings:
            order = SMOOTH if scales.wander == ROUGH else ROUGH
            scales, evidence, _ = self._better(scales, evidence, replace(scales, wander=order))
        if scales.alpha != LEVEL:
            scales, evidence = self._turned(scales, evidence)
            design = replace(scales, designed=not scales.designed, turns=())
            scales, evidence, _ = self._better(scales, evidence, design)
        for alpha in () if scales.alpha == LEVEL else ALPHAS:
            if alpha != scales.alpha:
                scales, evidence, _ = self._better(scales, evidence, replace(scales, alpha=alpha))
        return self._settled(scales), replace(scales, lost=tuple(self._lost)), evidence

    def central(self, level: bool) -> RoadScales:
        """Scales at the centres of their priors, without noise of the power, and the better order of the wander."""
        model = RoadModel(self._strides, LEVEL if level else ALPHAS[0], ROUGH, power=False)
        values = np.array([scale.centre for scale in model.scales])
        values[POWER] = model.scales[POWER].low
        if level:
            values[SLOPE] = model.scales[SLOPE].low
        scales = RoadScales(
            values=values,
            point=self.point,
            alpha=model.alpha,
            wander=ROUGH,
            readings=model.reading_names,
            lag=len(LAGS) // 2,
        )
        orders = [scales, replace(scales, wander=SMOOTH)] if scales.readings else [scales]
        return max(orders, key=lambda scales: self.likelihood(scales).log_evidence(scales.values))

    def _better(self, scales: RoadScales, evidence: float, other: RoadScales) -> tuple[RoadScales, float, float]:
        """The ``scales``, or the most probable of ``other`` orders where these have more evidence, and their lead.

        A lead [nats] above CLEAR is not exact.
        """
        varied, found = self._improved(self._start(other, scales), evidence - CLEAR)
        if found > evidence:
            scales, evidence, varied, found = varied, found, scales, evidence
        if np.isfinite(found):
            self._lost.append(replace(varied, lost=()))
        self._models = {self._key(scales): self.model(scales)}  # others take memory, and are not asked for again
        return scales, evidence, evidence - found

    def _start(self, other: RoadScales, scales: RoadScales) -> RoadScales:
        """``other``, or its orders with values from the search before, if these have more evidence.

        The values have since changed as those of the ``scales`` have.
        """
        known = self._known
        if known is None:
            return other
        change = scales.values / known.values if known.orders == scales.orders else np.ones(len(scales.values))
        ended = [replace(other, values=_changed(lost, change)) for lost in known.lost if lost.orders == other.orders]
        evidence = self.likelihood(other).log_evidence
        return max([other, *ended], key=lambda scales: evidence(scales.values)) if ended else other

    def _turned(self, scales: RoadScales, evidence: float) -> tuple[RoadScales, float]:
        """The scales with turns where these add evidence, one after the other; a designed road needs none."""
        for place in scales.turns:  # of a part of the drive before
            less = replace(scales, turns=tuple(other for other in scales.turns if other != place))
            if self._gains(scales, [less])[0] > 0:
                scales, evidence = self._improved(less)
        while not scales.designed:
            places = _sharpest(self.likelihood(scales), scales)
            more = [replace(scales, turns=(*scales.turns, place)) for place in places]
            gains = self._gains(scales, more)
            if max(gains, default=0.0) <= 0:
                break
            scales, evidence = self._improved(more[int(np.argmax(gains))])
        return scales, evidence

    def _gains(self, scales: RoadScales, others: Sequence[RoadScales]) -> list[float]:
        """Gain in log evidence of each of ``others`` with equal values; their models are not kept."""
        before = self.likelihood(scales).log_evidence(scales.values) - scales.price
        likelihoods = (self._likelihood_of(self._model_like(other), other) for other in others)
        return [
            likelihood.log_evidence(scales.values) - other.price - before
            for likelihood, other in zip(likelihoods, others, strict=True)
        ]

    def _improved(self, scales: RoadScales, worth: float = -np.inf) -> tuple[RoadScales, float]:
        """The most probable scales from those given; others where they cannot have the log evidence ``worth``."""
        likelihood = self.likelihood(scales)
        values, evidence = most_probable(likelihood, scales.values, scales.free, worth + scales.price)
        return replace(scales, values=values), evidence - scales.price

    def _lagged(self, scales: RoadScales) -> tuple[RoadScales, float]:
        """Scales and the nearest lag of LAGS, each given the other; of lags that call for each other the better one."""
        found: dict[int, tuple[RoadScales, float]] = {}
        while scales.lag not in found:
            scales, evidence = self._improved(scales)
            found[scales.lag] = scales, evidence
            left = float(np.clip(self._follow(self.likelihood(scales), scales), -LAG_SPACING, LAG_SPACING))
            if abs(left) < 0.55 * LAG_SPACING:
                return scales, evidence
            wanted = np.clip(LAGS[scales.lag] + left, -self._longest_lag, self._longest_lag)
            scales = replace(scales, lag=int(np.argmin(np.abs(LAGS - wanted))))
        return max(found.values(), key=lambda pair: pair[1])

    def _settled(self, scales: RoadScales, passes: int = 0) -> Likelihood:
        """The likelihood with what effects take at ``scales``; an inertia takes of the acceleration it is fitted to."""
        has_inertia = any(term.effect.inertia is not None for term in self._terms)
        for _ in range(max(passes, INERTIA_PASSES if has_inertia else 0)):
            self._follow(self.likelihood(scales), scales)
        return self.likelihood(scales)

    def _follow(self, likelihood: Likelihood, scales: RoadScales) -> float:
        """Take the road load, and what effects take, as they are at ``scales``; the lag [s] that its place leaves."""
        beta, _, _ = likelihood.solve(likelihood.at(scales.values)[1])
        beta = beta / likelihood.unit
        self._road_load = scaled_by(beta)
        m, driven = float(self._road_load[2]), likelihood.model.driven
        sizes = -beta[len(beta) - len(self._terms) :] * m
        self._taken = taken_by(driven, driven.force[:, scales.lag], self._road_load, self._terms, sizes)
        return float(beta[LAG] * m)


def _sharpest(likelihood: Likelihood, scales: RoadScales) -> list[Place]:
    """Slow places where the change of the slope, by ``scales``, itself changes most; none that a turn is at."""
    nodes = likelihood.model.nodes
    conditioned, gram = likelihood.at(scales.values)
    slope, _ = likelihood.model.road(conditioned.unknowns(likelihood.data @ np.append(1.0, -likelihood.solve(gram)[0])))
    bent = np.abs(np.diff(slope, 2, prepend=slope[0], append=slope[-1]))
    slow = nodes.slow_places()
    places = [(a, b) for a, b in slow if not any(a < end and begin < b for begin, end in scales.turns)]
    edges = [np.searchsorted(nodes.s, place) for place in places]
    sharpness = np.array([bent[begin : end + 1].max() for begin, end in edges])
    return [places[i] for i in np.argsort(-sharpness, kind="stable")[:TRIED_TURNS]]


def _changed(scales: RoadScales, change: Floats) -> Floats:
    """Values of scales times a ``change`` (k,), but for those that the model does not have."""
    values = scales.values.copy()
    values[scales.free] *= change[scales.free]
    return values


def _other_noise(scales: RoadScales) -> RoadScales:
    """Scales without noise of the power if they have it, else with it in place of noise of the torque."""
    values, torque, power = scales.values.copy(), slice(TORQUE, TORQUE + 2), slice(POWER, POWER + 2)
    centres = np.array([scale.centre for scale in SCALES])
    if scales.has_power:
        values[TORQUE] = np.hypot(values[TORQUE], values[POWER])
        values[POWER], values[POWER + 1] = SCALES[POWER].low, centres[POWER + 1]
    else:
        values[power], values[torque] = values[torque], centres[torque]
    return replace(scales, values=values)

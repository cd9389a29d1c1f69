"""The vehicle's parameters from strides, with the road as a state: scales by their posterior mode, then the vehicle.

The coefficients beta = [1/m, A/m, C/m, lag/m, drag/m, earlier loads ..., offsets ..., -b/m ...] are those of
`road_likelihood`, from its `normal_equations` at the scales; the doubt of the model's form (`form_doubt`) widens them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from estimator.estimation.form_doubt import with_doubt_of_effects, with_doubt_of_form
from estimator.estimation.normal_equations import NormalEquations
from estimator.estimation.road_likelihood import (
    LAG,
    ROAD_LOAD,
    Likelihood,
    columns,
    shapes_of,
    taken_by,
)
from estimator.estimation.scale_search import most_probable
from estimator.model.design_matrix import MIN_DRAG, MIN_ROLLING, Term
from estimator.model.effects.effect import AtRest
from estimator.model.road import ALPHAS, LEVEL, ROUGH, SMOOTH, RoadModel
from estimator.model.road_nodes import Place, warping
from estimator.model.road_scales import LENGTH, POWER, SCALES, SLOPE, TORQUE
from estimator.signals import Floats
from estimator.strides import LAGS, Strides
from estimator.units import STANDARD_GRAVITY

# Log evidence that noise of the power needs to be in the model: it explains nearly what noise of the torque does, and
# the coefficients are corrected for the latter alone. It has 24 to 318 where it is real (a truck at 1 Hz, a BMW i3).
POWER_PRICE = 3.0
# The same for a road that is smoother than crests and dips make it: drives of minutes hardly tell, and beside a smooth
# road their masses were too sure (errors of 1.4 to 1.9 standard deviations in the first six minutes, else 1.0 to 1.3).
SMOOTH_PRICE = 3.0
# The same for a road that is designed for the speed it is driven at: on level simulated roads it has up to 8 where
# loads act at low speed. On 21 of 28 trips of the BMW it has more, 16 in the median; with the accelerometer on 25, 38.
DESIGNED_PRICE = 8.0
# The same for each place where the vehicle turns: of 240 other slow places on six simulated drives none had more than
# 3.4. On these drives the turn of a route there and back had 28 to 48.
TURN_PRICE = 8.0
TRIED_TURNS = 3  # slow places where the slope bends most, for each one that is found: bounds the cost
MAX_EXPONENT = 500.0  # of the exponential function in floating point
MIN_STRIDES = 30  # strides with a known force, 30 s: with fewer there is no fit
PASSES = 2  # of the coefficients, given the scales, that effects scale with
LAG_SPACING = float(LAGS[1] - LAGS[0])  # s


@dataclass(frozen=True, kw_only=True)
class RoadScales:
    """Scales of road and noise (k,) in the order of `RoadModel.scales`, the orders of road and wander, and design."""

    values: Floats
    alpha: int  # of ALPHAS, or LEVEL
    wander: int  # order of the wander of the signals of the road
    readings: tuple[str, ...]  # those signals, whose scales are among the values
    lag: int  # place in LAGS
    designed: bool = False  # the road is designed for the speed it is driven at
    turns: tuple[Place, ...] = ()  # where slopes change at once
    power_chance: float = 0.0  # probability that noise of the power is there, where it is not in the model

    @property
    def has_power(self) -> bool:
        """Whether noise of the power is in the model."""
        return bool(self.values[POWER] > SCALES[POWER].low)

    @property
    def price(self) -> float:
        """By how much more log evidence these orders need."""
        smooth = SMOOTH_PRICE * (self.alpha == ALPHAS[-1])
        changes = 0.0 if self.alpha == LEVEL else DESIGNED_PRICE * self.designed + TURN_PRICE * len(self.turns)
        return POWER_PRICE * self.has_power + smooth + changes

    def warping(self, speed: Floats) -> Floats:
        """By how much (n,) sooner slopes change at a ``speed`` [m/s] (n,) than over the length among the scales."""
        return warping(speed) if self.designed else np.ones(len(speed))

    @property
    def free(self) -> list[int]:
        """Places of the scales that the model has."""
        held = [*([SLOPE, LENGTH] if self.alpha == LEVEL else []), *([] if self.has_power else [POWER, POWER + 1])]
        return [i for i in range(len(self.values)) if i not in held]

    def model_of(self, strides: Strides) -> RoadModel:
        """The model of strides that these are scales of."""
        return RoadModel(strides, self.alpha, self.wander, self.has_power, self.designed, self.turns)


@dataclass(frozen=True, kw_only=True)
class RoadFit:
    """Gaussian approximation of the likelihood of beta, nuisances' priors included; see the module."""

    beta: Floats  # (p,)
    covariance: Floats  # (p, p), doubts included
    scales: RoadScales
    log_evidence: float  # with the prior of the scales, where these were searched for
    terms: tuple[Term, ...]
    strides: Strides  # those with a known force
    fitted: Floats  # (n,) acceleration by the vehicle's part and the road [m/s^2]
    slope: Floats  # (n,) of the road at the strides
    slope_sd: float  # expected, of the slope along this road; that of the process is among the scales
    slope_doubt: float  # posterior sd of the slope at a place, rms
    climbed: float  # [m], all rises of the road together
    equations: NormalEquations = field(repr=False)
    departures: tuple[float, ...] = ()  # times [s] before which the load may have changed

    @property
    def theta(self) -> Floats:
        """A [N], C [N s^2/m^2], m [kg], lag [s] and then the effects' magnitudes (4 + effects,), at beta."""
        return theta_of(self.beta, len(self.terms))

    @property
    def road_load(self) -> Floats:
        """[A, C, m] (3,) that effects scale with, see `scaled_by`."""
        return scaled_by(self.beta)

    @cached_property
    def taken(self) -> Floats:
        """Force [N] (n,) that the effects take from acceleration, but for those computed from it."""
        force = self.strides.force[:, self.scales.lag]
        return taken_by(self.strides, force, self.road_load, self.terms, self.theta[LAG + 1 :])

    @property
    def lag(self) -> float:
        """By how much power comes after speed [s]."""
        return float(LAGS[self.scales.lag] + self.beta[LAG] / self.beta[0])

    def theta_covariance(self) -> Floats:
        """Covariance (4 + effects, 4 + effects) of `theta`, to first order."""
        jacobian = theta_jacobian(self.beta, len(self.terms))
        spread: Floats = jacobian @ self.covariance @ jacobian.T
        return spread

    def mixed(self, shift: Floats, covariance: Floats) -> "RoadFit":
        """The same, with what other models add to the first coefficients: a shift (b,) and covariance (b, b)."""
        b, beta, wider = len(shift), self.beta.copy(), self.covariance.copy()
        beta[:b] += shift
        wider[:b, :b] += covariance
        return replace(self, beta=beta, covariance=wider)

    @property
    def slope_length(self) -> float:
        """Length [m] over which the slope changes; where that depends on the speed, at those of the drive.

        A drive determines sd^2 / length^(2 nu) of a process of smoothness nu (Zhang 2004), and each of both badly: a
        road of single hills has the slopes of a process with a larger sd and a greater length.
        """
        nu = max(self.scales.alpha, 1) - 0.5
        ratio = self.slope_sd / float(self.scales.values[SLOPE])
        length = self.scales.values[LENGTH] / self.scales.warping(self.strides.speed).mean()
        return float(length * ratio ** (1 / nu))

    @property
    def residual_power(self) -> Floats:
        """Residual power [W] (n,) of the model with the road, at the strides."""
        left: Floats = (self.fitted - self.strides.a) / float(self.beta[0]) * self.strides.speed
        return left


def theta_of(beta: Floats, effects: int) -> Floats:
    """A, C, m, lag and magnitudes from coefficients (p,)."""
    m = 1 / beta[0]
    return np.concatenate([[beta[1] * m, beta[2] * m, m, beta[LAG] * m], -beta[len(beta) - effects :] * m])


def theta_jacobian(beta: Floats, effects: int) -> Floats:
    """Derivative (4 + effects, p) of `theta_of`."""
    m, p = 1 / beta[0], len(beta)
    theta = theta_of(beta, effects)
    jacobian = np.zeros((4 + effects, p))
    jacobian[:, 0] = -theta * m
    places = [1, 2, 0, LAG, *range(p - effects, p)]
    signs = [1.0, 1.0, 0.0, 1.0, *([-1.0] * effects)]
    for i, (place, sign) in enumerate(zip(places, signs, strict=True)):
        jacobian[i, place] += sign * m
    return jacobian


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


def fit(
    strides: Strides,
    rng: np.random.Generator,
    terms: Sequence[Term] = (),
    known: RoadScales | None = None,
    longest_lag: float = float(LAGS.max()),
    departures: Sequence[float] = (),
    level: bool = False,
    rests: Sequence[AtRest] = (),
) -> RoadFit | None:
    """Fit strides, with the most probable scales of road and noise.

    None where too few strides have a known force, or none of these accelerates (a speed that is stuck).

    Parameters
    ----------
    strides
        With and without known force, in order of time.
    rng
        Source of the simulated noise of the correction.
    terms
        Effects beyond the road load.
    known
        Scales found before, to start from.
    longest_lag
        Largest lag of power behind speed that is tried [s].
    departures
        Times [s] before which the load may have changed; the mass is that after the last of them.
    level
        Whether the road has no slopes.
    rests
        The power while the vehicle stood, as far as it is known.
    """
    driven = strides[strides.known]
    if len(driven) < MIN_STRIDES or not driven.a.any():
        return None
    search = _Search(strides, terms, first_guess(driven), longest_lag, departures)
    if known is not None:
        here = tuple(place for place in known.turns if strides.s0[0] < place[1] and place[0] < strides.s1[-1])
        known = replace(known, turns=here) if known.readings == search.model(known).reading_names else None
    return _concluded(*search.best(known, level), rng, rests)


def fit_given(
    strides: Strides,
    rng: np.random.Generator,
    scales: RoadScales,
    terms: Sequence[Term] = (),
    longest_lag: float = float(LAGS.max()),
    departures: Sequence[float] = (),
    rests: Sequence[AtRest] = (),
) -> RoadFit | None:
    """Fit strides as `fit` does, with ``scales`` as they are; they are found where other signals show the road."""
    driven = strides[strides.known]
    if len(driven) < MIN_STRIDES or not driven.a.any():
        return None
    search = _Search(strides, terms, first_guess(driven), longest_lag, departures)
    if scales.readings != search.model(scales).reading_names:
        return fit(strides, rng, terms, None, longest_lag, departures, rests=rests)
    return _concluded(*search.given(scales), rng, rests)


def refit(
    found: RoadFit, strides: Strides, rng: np.random.Generator, terms: Sequence[Term], rests: Sequence[AtRest] = ()
) -> RoadFit:
    """Fit the ``strides`` of a fit with other terms: scales are found again, orders and the design of the road kept.

    Its equations have no changes during the drive. ``rests``: the power while the vehicle stood.
    """
    search = _Search(strides, terms, found.road_load, taken=found.taken)
    return _concluded(*search.improved(found.scales), rng, rests, with_changes=False)


class _Search:
    """The search for the scales, the smoothness of the road and the nearest of LAGS."""

    def __init__(
        self,
        strides: Strides,
        terms: Sequence[Term],
        road_load: Floats,
        longest_lag: float = float(LAGS.max()),
        departures: Sequence[float] = (),
        taken: Floats | float = 0.0,
    ) -> None:
        self._strides, self._terms, self._road_load, self._longest_lag = strides, terms, road_load, longest_lag
        self._departures, self._taken = departures, taken
        self._models: dict[tuple[int, int, bool, bool, tuple[Place, ...]], RoadModel] = {}

    def model(self, scales: RoadScales) -> RoadModel:
        """The strides' model that belongs to scales."""
        key = scales.alpha, scales.wander, scales.has_power, scales.designed, scales.turns
        if key not in self._models:
            self._models[key] = scales.model_of(self._strides)
        return self._models[key]

    def likelihood(self, scales: RoadScales) -> Likelihood:
        """The likelihood that belongs to scales."""
        return self._likelihood_of(self.model(scales), scales)

    def _likelihood_of(self, model: RoadModel, scales: RoadScales) -> Likelihood:
        return Likelihood(model, self._terms, self._road_load, scales.lag, self._departures, self._taken)

    def given(self, scales: RoadScales) -> tuple[Likelihood, RoadScales, float]:
        """With ``scales`` as they are; effects scale with the road load that is found beside them."""
        for _ in range(PASSES if self._terms else 0):
            self._follow(self.likelihood(scales), scales)
        likelihood = self.likelihood(scales)
        return likelihood, scales, likelihood.log_evidence(scales.values) - scales.price

    def improved(self, known: RoadScales) -> tuple[Likelihood, RoadScales, float]:
        """The most probable scales from those ``known``, of the same orders; their likelihood and log evidence."""
        scales, evidence = self._lagged(known)
        return self.likelihood(scales), scales, evidence

    def best(self, known: RoadScales | None, level: bool) -> tuple[Likelihood, RoadScales, float]:
        """The same with orders found too; without scales ``known``, from the centres of their priors."""
        scales, evidence = self._lagged(known or self._central(level))
        other, found = self._improved(_other_noise(scales))
        if found > evidence:
            scales, evidence, found = other, found, evidence
        chance = 0.0 if scales.has_power else 1 / (1 + float(np.exp(min(evidence - found, MAX_EXPONENT))))
        scales = replace(scales, power_chance=chance)
        if scales.readings:
            order = SMOOTH if scales.wander == ROUGH else ROUGH
            scales, evidence = self._better(scales, evidence, replace(scales, wander=order))
        if scales.alpha != LEVEL:
            scales, evidence = self._turned(scales, evidence)
            scales, evidence = self._better(scales, evidence, replace(scales, designed=not scales.designed, turns=()))
        for alpha in () if scales.alpha == LEVEL else ALPHAS:
            if alpha != scales.alpha:
                scales, evidence = self._better(scales, evidence, replace(scales, alpha=alpha))
        return self.likelihood(scales), scales, evidence

    def _central(self, level: bool) -> RoadScales:
        """Scales at the centres of their priors, without noise of the power."""
        model = RoadModel(self._strides, LEVEL if level else ALPHAS[0], ROUGH, power=False)
        values = np.array([scale.centre for scale in model.scales])
        values[POWER] = model.scales[POWER].low
        if level:
            values[SLOPE] = model.scales[SLOPE].low
        return RoadScales(
            values=values, alpha=model.alpha, wander=ROUGH, readings=model.reading_names, lag=len(LAGS) // 2
        )

    def _better(self, scales: RoadScales, evidence: float, other: RoadScales) -> tuple[RoadScales, float]:
        """The ``scales``, or the most probable of ``other`` orders where these have more evidence."""
        varied, found = self._improved(other)
        return (varied, found) if found > evidence else (scales, evidence)

    def _turned(self, scales: RoadScales, evidence: float) -> tuple[RoadScales, float]:
        """The scales with turns where these add evidence, one after the other; a designed road needs none."""
        while not scales.designed:
            likelihood = self.likelihood(scales)
            before = likelihood.log_evidence(scales.values)
            tried = [replace(scales, turns=(*scales.turns, place)) for place in _sharpest(likelihood, scales)]
            models = (one.model_of(self._strides) for one in tried)
            gains = [
                self._likelihood_of(model, one).log_evidence(scales.values) - before
                for one, model in zip(tried, models, strict=True)
            ]
            if max(gains, default=0.0) <= TURN_PRICE:
                break
            scales, evidence = self._improved(tried[int(np.argmax(gains))])
        return scales, evidence

    def _improved(self, scales: RoadScales) -> tuple[RoadScales, float]:
        """The most probable scales from those given."""
        likelihood = self.likelihood(scales)
        values, evidence = most_probable(likelihood, scales.values, scales.free)
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
    """Slow places where the change of the slope, by ``scales``, itself changes most; none that is among them."""
    nodes = likelihood.model.nodes
    conditioned, gram = likelihood.at(scales.values)
    slope, _ = likelihood.model.road(conditioned.unknowns(likelihood.data @ np.append(1.0, -likelihood.solve(gram)[0])))
    bent = np.abs(np.diff(slope, 2, prepend=slope[0], append=slope[-1]))
    places = [place for place in nodes.slow_places() if place not in scales.turns]
    edges = [np.searchsorted(nodes.s, place) for place in places]
    sharpness = np.array([bent[begin : end + 1].max() for begin, end in edges])
    return [places[i] for i in np.argsort(-sharpness, kind="stable")[:TRIED_TURNS]]


def _other_noise(scales: RoadScales) -> RoadScales:
    """Without noise of the power where it is there, else with it in the place of noise of the torque."""
    values, torque, power = scales.values.copy(), slice(TORQUE, TORQUE + 2), slice(POWER, POWER + 2)
    centres = np.array([scale.centre for scale in SCALES])
    if scales.has_power:
        values[TORQUE] = np.hypot(values[TORQUE], values[POWER])
        values[POWER], values[POWER + 1] = SCALES[POWER].low, centres[POWER + 1]
    else:
        values[power], values[torque] = values[torque], centres[torque]
    return replace(scales, values=values)


def _beside(rest: AtRest, beta: Floats, covariance: Floats, terms: Sequence[Term]) -> tuple[Floats, Floats, float]:
    """Coefficients (p,) and their covariance with the power at rest, which ``terms`` take, and its log density.

    To first order, as the update of a Kalman filter.
    """
    power = np.array([term.at_rest(rest) for term in terms]) / rest.sd  # per unit of each magnitude
    missed = rest.power / rest.sd - float(power @ theta_of(beta, len(terms))[LAG + 1 :])
    weights = power @ theta_jacobian(beta, len(terms))[LAG + 1 :]
    shared = covariance @ weights
    variance = 1.0 + float(weights @ shared)
    gain = -0.5 * (missed**2 / variance + float(np.log(2 * np.pi * variance)))
    return beta + shared * missed / variance, covariance - np.outer(shared, shared) / variance, gain


def _concluded(
    likelihood: Likelihood,
    scales: RoadScales,
    evidence: float,
    rng: np.random.Generator,
    rests: Sequence[AtRest],
    with_changes: bool = True,
) -> RoadFit:
    """Coefficients with all doubts in their covariance, and the road that they leave."""
    model, unit = likelihood.model, likelihood.unit
    conditioned, _ = likelihood.at(scales.values)
    shapes = shapes_of(model.driven.t >= max(likelihood.departures, default=-np.inf))[:, : None if with_changes else 0]
    equations = NormalEquations.of(likelihood, scales.values, scales.free, scales.power_chance, shapes, rng)
    beta, covariance, _ = equations.solve()
    beta, covariance = beta / unit, covariance / np.outer(unit, unit)
    for rest in rests:
        beta, covariance, gain = _beside(rest, beta, covariance, likelihood.terms)
        evidence += gain
    covariance = with_doubt_of_effects(beta, covariance, len(likelihood.terms))
    residual = likelihood.data[:, 0] - likelihood.data[:, 1:] @ (beta * unit)
    n = len(model.driven)
    at_nodes, slope = model.road(conditioned.unknowns(residual))
    rises = 0.5 * (at_nodes[1:] + at_nodes[:-1]) * np.diff(model.nodes.s)
    fitted = likelihood.data[:n, 1:] @ (beta * unit) - STANDARD_GRAVITY * slope
    slope_doubt = float(np.sqrt(np.mean(conditioned.slope_variance)))
    slope_sd = float(np.hypot(np.std(at_nodes), slope_doubt))
    covariance = with_doubt_of_form(beta, covariance, slope_sd, hidden=not scales.readings)
    return RoadFit(
        beta=beta,
        covariance=covariance,
        scales=scales,
        log_evidence=evidence,
        terms=likelihood.terms,
        strides=model.driven,
        fitted=fitted,
        slope=slope,
        slope_sd=slope_sd,
        slope_doubt=slope_doubt,
        climbed=float(rises[model.nodes.joined[1:] & (rises > 0)].sum()),
        equations=equations,
        departures=likelihood.departures,
    )

"""The vehicle's parameters from strides, with the road as a state: scales by their posterior mode, then the vehicle.

The response is the acceleration, the regressors are the columns of `columns`, and the coefficients

    beta = [1/m, A/m, C/m, lag/m, drag/m, offsets ..., -b/m ...]

enter linearly. Noise of the measured torque sits in the regressors too and would pull 1/m towards zero. With its
scale known from the same fit the normal matrix is corrected (a corrected score: Nakamura 1990, Stefanski 1989):

    X'K^-1 X  less  the mean over simulated noise d of  dX' K^-1 dX,   dX = X(F + d) - X(F)

The correction assumes that the driver reacts to the measured speed alone; drivers also react to the slope itself. So a
share of the correction (CORRECTION_DOUBT) and a floor for the sd of the mass (FORM_SD) widen the covariance. Both were
measured on simulated drives over hidden hills: mixed, highway and urban roads, speed noise 0..30 mm/s, torque in 0.125
and 1 %.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize

from estimator.model.design_matrix import Term
from estimator.model.effects.effect import View
from estimator.model.linear_gaussian import NotPositiveDefiniteError
from estimator.model.ornstein_uhlenbeck import mean_given_ends
from estimator.model.road import ALPHAS, ROUGH, SMOOTH, Conditioned, RoadModel, Scale
from estimator.signals import Floats
from estimator.strides import DURATION, LAGS, Strides
from estimator.units import STANDARD_GRAVITY

ROAD_LOAD = 3  # the first coefficients
LAG, DRAG = 3, 4  # places of the nuisances
PLAIN = 5  # coefficients without offsets and effects
LAG_SD = 0.15  # s, prior of what is left of the lag after the nearest of LAGS
DRAG_SD = 0.03  # share by which the engine's drag at the wheels may differ from what the bus says (gearbox losses)
USUAL_SDS = 3.0  # prior sd of an effect's magnitude, in usual magnitudes
VAGUE = (5e-3, 1.0, 1e-2)  # prior sd of 1/m [1/kg], A/m [m/s^2], C/m [1/m]: far beyond any vehicle
PROBES = 8  # simulated noises that the correction is averaged over
MAX_NOISE_SHARE = 0.3  # of noise in the information on 1/m: beyond, the whole correction counts as sd
MAX_CORRECTED_SHARE = 0.7  # of the information in any direction, that is subtracted as noise
CORRECTION_DOUBT = 0.5  # share of the correction's shift that counts as a standard deviation
FORM_SD = 0.0025  # of 1/m: what the model's form leaves on any road (friction in steps of 1 %)
FORM_SLOPE = 0.4  # sd of 1/m per unit of the slopes' sd where no signal shows them: the driver reacts to slopes
ROAD_DOUBT = 0.8  # share of their sd by which A / m and C / m are wider there: real roads are no Matern process
MIN_STRIDES = 30  # strides
SCALE_TOLERANCE = 0.1  # of the logarithms of the scales, at which the search stops
MAX_EVALUATIONS = 120  # of the likelihood in one search
UNKNOWN_SCALE_STEP, KNOWN_SCALE_STEP = 0.7, 0.25  # first steps of the logarithms of scales, unknown or known before
ROAD_SCALES = (0, 4, 5)  # scales that change with the smoothness of the road
VEHICLE_SCALES = (2, 3)  # scales that do not change with the smoothness of the wander
LAG_PASSES = 4
LAG_SPACING = float(LAGS[1] - LAGS[0])  # s


@dataclass(frozen=True, kw_only=True)
class RoadScales:
    """Scales of road and noise (k,) in the order of `RoadModel.scales`, and the orders of road and wander."""

    values: Floats
    alpha: int
    wander: int  # order of the wander of the signals of the road
    readings: tuple[str, ...]  # those signals, whose scales are among the values
    lag: int  # place in LAGS

    def named(self, model: RoadModel) -> dict[str, float]:
        """The scales by name."""
        return {scale.name: float(value) for scale, value in zip(model.scales, self.values, strict=True)}


@dataclass(frozen=True, kw_only=True)
class RoadFit:
    """Gaussian approximation of the likelihood of beta, nuisances' priors included; see the module."""

    beta: Floats  # (p,)
    covariance: Floats  # (p, p), doubts included
    scales: RoadScales
    log_evidence: float
    terms: tuple[Term, ...]
    strides: Strides  # those with a known force
    fitted: Floats  # (n,) acceleration by the vehicle's part and the road [m/s^2]
    slope: Floats  # (n,) of the road at the strides
    slope_sd: float
    climbed: float  # [m], all rises of the road together
    torque_share: float  # of the information on 1/m that is noise of the torque

    @property
    def theta(self) -> Floats:
        """A [N], C [N s^2/m^2], m [kg], lag [s] and then the effects' magnitudes (4 + effects,), at beta."""
        return theta_of(self.beta, len(self.terms))

    @property
    def lag(self) -> float:
        """By how much power comes after speed [s]."""
        return float(LAGS[self.scales.lag] + self.beta[LAG] / self.beta[0])

    def theta_covariance(self) -> Floats:
        """Covariance (4 + effects, 4 + effects) of `theta`, to first order."""
        jacobian = theta_jacobian(self.beta, len(self.terms))
        spread: Floats = jacobian @ self.covariance @ jacobian.T
        return spread

    def with_doubt_of_mass(self, share: float) -> "RoadFit":
        """The same with a relative sd of 1/m of at least ``share``, as from a wrong gain of the torque."""
        missing = share**2 - float(self.covariance[0, 0]) / float(self.beta[0]) ** 2
        if missing <= 0:
            return self
        form = np.append(np.sqrt(missing) * self.beta[0], np.zeros(len(self.beta) - 1))
        return replace(self, covariance=self.covariance + np.outer(form, form))

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


def columns(strides: Strides, lag: int, terms: Sequence[Term], road_load: Floats) -> Floats:
    """Regressors (n, PLAIN + terms) of the acceleration, for force at the lag with number ``lag`` of LAGS."""
    force = strides.force[:, lag]
    low, high = max(lag - 1, 0), min(lag + 1, len(LAGS) - 1)
    rate = (strides.force[:, high] - strides.force[:, low]) / (LAGS[high] - LAGS[low])
    density = strides.relative_density
    plain = [force, -np.ones(len(strides)), -density * strides.speed_squared, rate, np.minimum(force, 0.0)]
    A, C, m = road_load.tolist()
    level = (force - A - C * density * strides.speed_squared) / m  # the measured acceleration has the road in it
    view = View(
        t=strides.t,
        v=strides.speed,
        a=level,
        P=force * strides.speed,
        density=density,
        context=strides.context,
        road_load=road_load,
        climb=np.zeros(len(strides)),
    )
    return np.column_stack([*plain, *(term.column(view) / strides.speed for term in terms)])


class Likelihood:
    """Likelihood of one set of strides as a function of the scales.

    Parameters
    ----------
    model
        The strides' model.
    terms
        Effects beyond the road load.
    road_load
        [A, C, m] roughly: effects scale with it, and the nuisances' priors are in proportion to 1/m.
    lag
        Place in LAGS.
    """

    def __init__(self, model: RoadModel, terms: Sequence[Term], road_load: Floats, lag: int) -> None:
        self.model, self.lag, self.terms = model, lag, tuple(terms)
        self._road_load = road_load
        X = columns(model.driven, lag, terms, road_load)
        data = model.given(np.column_stack([model.driven.a, X]))
        inside = data.shape[1] - 1 - X.shape[1]  # offsets of the road's signals stand behind
        self.order = [*range(1, 1 + PLAIN), *range(1 + X.shape[1], data.shape[1]), *range(1 + PLAIN, 1 + X.shape[1])]
        self.data = data[:, [0, *self.order]]
        self.unit = np.maximum(np.sqrt(np.mean(self.data[: len(X), 1:] ** 2, axis=0)), 1e-12)
        self.unit[PLAIN : PLAIN + inside] = 1.0
        self.data[:, 1:] /= self.unit
        m = float(road_load[2])
        sds = [*VAGUE, LAG_SD / m, DRAG_SD / m, *([1.0] * inside)]
        sds += [USUAL_SDS * term.effect.usual(road_load) / m for term in terms]
        self.prior = np.diag((np.array(sds) * self.unit) ** -2.0)

    def solve(self, gram: Floats) -> tuple[Floats, Floats, float]:
        """Coefficients (p,), their information (p, p) and -2 log likelihood without log|K|; in own units."""
        information = gram[1:, 1:] + self.prior
        beta = np.linalg.solve(information, gram[1:, 0])
        return beta, information, float(gram[0, 0] - gram[1:, 0] @ beta)

    def log_evidence(self, scales: Floats) -> float:
        """Log marginal likelihood of ``scales`` (k,), coefficients integrated out, up to a constant of the model."""
        try:
            conditioned = self.model.condition(scales)
        except NotPositiveDefiniteError:
            return -1e10
        _, information, misfit = self.solve(conditioned.gram(self.data))
        volume = float(np.linalg.slogdet(information)[1] - np.log(np.diag(self.prior)).sum())
        return -0.5 * (conditioned.log_determinant + volume + misfit)

    def best_scales(self, start: Floats, free: Sequence[int], reach: float) -> tuple[Floats, float]:
        """Scales (k,) at the mode of their posterior, from ``start``, and the log evidence there with their prior.

        Those with numbers in ``free`` are varied, at first by a factor of exp(``reach``).
        """
        scales: Sequence[Scale] = self.model.scales
        centre, spread = np.log([s.centre for s in scales]), np.array([s.spread for s in scales])

        place, origin = list(free), np.log(start)

        def loss(varied: Floats) -> float:
            logarithms = origin.copy()
            logarithms[place] = varied
            prior = float(np.sum(((logarithms - centre) / spread) ** 2))
            return 0.5 * prior - self.log_evidence(np.exp(logarithms))

        bounds = [(np.log(scales[i].low), np.log(scales[i].high)) for i in place]
        found = minimize(
            loss,
            origin[place],
            method="COBYQA",
            bounds=bounds,
            options={"initial_tr_radius": reach, "final_tr_radius": SCALE_TOLERANCE, "maxfev": MAX_EVALUATIONS},
        )
        best = start.copy()
        best[place] = np.exp(found.x)
        return best, -float(found.fun)

    def noise_information(
        self, scales: Floats, conditioned: Conditioned, beta: Floats, rng: np.random.Generator
    ) -> Floats:
        """Mean of dX' K^-1 dX (p, p) over simulated errors of the measured force; in own units."""
        driven, total = self.model.driven, np.zeros((len(beta), len(beta)))
        clean = columns(driven, self.lag, self.terms, self._road_load)
        places = np.array([*range(PLAIN), *range(len(beta) - len(self.terms), len(beta))])
        for error, rate in force_errors(self.model, scales, float(self.unit[0] / beta[0]), PROBES, rng):
            disturbed = replace(driven, force=driven.force + error[:, None])
            change = columns(disturbed, self.lag, self.terms, self._road_load) - clean
            change[:, LAG] = rate
            data = np.zeros((len(self.data), len(places)))
            data[: len(driven)] = change / self.unit[places]
            total[np.ix_(places, places)] += conditioned.gram(data) / PROBES
        return total


def with_doubt_of_form(beta: Floats, covariance: Floats, slope_sd: float, hidden: bool) -> Floats:
    """The covariance (p, p) of beta (p,), with the uncertainty from the form of the model added.

    A / m and C / m are proportional to 1 / m, so an error of the form changes the mass alone. Over hidden hills their
    sd is larger by ROAD_DOUBT, in proportion to the slopes up to an sd of 0.4 %.
    """
    share = float(np.hypot(FORM_SD, FORM_SLOPE * slope_sd)) if hidden else FORM_SD
    form = share * np.concatenate([beta[:ROAD_LOAD], np.zeros(len(beta) - ROAD_LOAD)])
    wider = covariance.copy()
    if hidden:
        swamped = ROAD_DOUBT * min(slope_sd / 4e-3, 1.0)
        wider[1:ROAD_LOAD, 1:ROAD_LOAD] *= 1 + swamped**2
    return wider + np.outer(form, form)


def limited(noise: Floats, information: Floats) -> Floats:
    """The noise (p, p) in an information matrix, at most MAX_CORRECTED_SHARE of it in any direction.

    A direction with noise alone (the lag, where the force hardly changes) keeps some information.
    """
    unit = 1 / np.sqrt(np.diag(information))
    root = np.linalg.cholesky(information * np.outer(unit, unit))
    inverse = np.linalg.inv(root)
    shares, directions = np.linalg.eigh(inverse @ (noise * np.outer(unit, unit)) @ inverse.T)
    back = root @ directions
    kept: Floats = (back * np.minimum(shares, MAX_CORRECTED_SHARE)) @ back.T / np.outer(unit, unit)
    return kept


def force_errors(
    model: RoadModel, scales: Floats, mass: float, number: int, rng: np.random.Generator
) -> Iterator[tuple[Floats, Floats]]:
    """Simulated errors [N] (n,) of the measured force of each driven stride, and their rates [N/s] (n,)."""
    weight, own = mean_given_ends(DURATION, scales[1])
    keep, size = np.exp(-DURATION / scales[1]), scales[0] * mass
    for _ in range(number):
        before, after = (size * ends for ends in ou_at_ends(model, keep, rng))
        white = np.sqrt(own) * size * rng.standard_normal(len(model.driven))
        yield model.weight * (weight * (before + after) + white), model.weight * (after - before) / DURATION


def ou_at_ends(model: RoadModel, keep: float, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """An Ornstein-Uhlenbeck process of variance 1 at the beginning (n,) and the end (n,) of each driven stride."""
    n = len(model.driven)
    shocks = rng.standard_normal((2, n))
    before, after = np.empty(n), np.empty(n)
    last, gain = 0.0, np.sqrt(1 - keep**2)
    for k, joined in enumerate(model.joined.tolist()):
        start = last if joined else shocks[0, k]
        last = keep * start + gain * shocks[1, k]
        before[k], after[k] = start, last
    return before, after


def first_guess(strides: Strides) -> Floats:
    """Rough [A, C, m] (3,) by least squares of the acceleration, to scale priors with."""
    X = columns(strides, len(LAGS) // 2, (), np.array([1e3, 1.0, 1e4]))[:, :ROAD_LOAD]
    unit = np.sqrt(np.mean(X**2, axis=0))
    beta = np.linalg.lstsq(X / unit, strides.a, rcond=None)[0] / unit
    m = 1 / float(np.clip(beta[0], 1e-6, 5e-3))
    return np.array([max(beta[1] * m, 0.005 * 9.8 * m), max(beta[2] * m, 1e-5 * m), m])


def fit(
    strides: Strides,
    rng: np.random.Generator,
    terms: Sequence[Term] = (),
    known: RoadScales | None = None,
    refit: bool = True,
    longest_lag: float = float(LAGS.max()),
    orders: bool = True,
) -> RoadFit | None:
    """Fit strides; None where too few have a known force.

    Parameters
    ----------
    strides
        With and without known force, in order of time.
    rng
        Source of the simulated noise of the correction.
    terms
        Effects beyond the road load.
    known
        Scales found before, to start from; kept as they are unless ``refit``.
    refit
        Whether to look for the best scales and smoothness of the road.
    longest_lag
        Largest lag of power behind speed that is tried [s].
    orders
        Whether road and wander of other orders than the ``known`` are tried.
    """
    driven = strides[strides.known]
    if len(driven) < MIN_STRIDES:
        return None
    road_load = first_guess(driven)
    search = _Search(strides, terms, road_load, longest_lag)
    if known is not None and known.readings != search.model(known.alpha, known.wander).reading_names:
        known = None
    if known is not None and not refit:
        return _concluded(*search.likelihood(known), 0.0, rng)
    return _concluded(*search.best(known, orders), rng)


def best_shapes(strides: Strides, found: RoadFit, shapes: Sequence[Sequence[Term]]) -> tuple[Term, ...]:
    """Of each effect the term, among its ``shapes``, that adds most to the evidence of a fit; its sign counts."""
    terms = [term for each in shapes for term in each]
    model = RoadModel(strides, found.scales.alpha, found.scales.wander)
    likelihood = Likelihood(model, terms, found.theta[:ROAD_LOAD], found.scales.lag)
    gram = model.condition(found.scales.values).gram(likelihood.data)
    _, information, _ = likelihood.solve(gram)
    base = len(information) - len(terms)
    weights = np.linalg.solve(
        information[:base, :base], np.column_stack([information[:base, base:], gram[1:, :1][:base]])
    )
    strength = np.diag(information)[base:] - np.sum(information[:base, base:] * weights[:, :-1], axis=0)
    score = gram[1 + base :, 0] - information[base:, :base] @ weights[:, -1]
    believed = np.diag(likelihood.prior)[base:]
    wrong = np.array([term.effect.positive for term in terms]) & (score > 0)  # a coefficient is -b / m
    gain = np.where(wrong, 0.0, 0.5 * score**2 / strength) - 0.5 * np.log(strength / believed)
    chosen, at = list[Term](), 0
    for each in shapes:
        chosen += [each[int(np.argmax(gain[at : at + len(each)]))]] if each else []
        at += len(each)
    return tuple(chosen)


def log_bayes_factor_of_road(strides: Strides, found: RoadFit) -> float:
    """Of the road that was ``found`` under strides against a level one, the other scales found again without it."""
    return _log_evidence(strides, found, is_level=False) - _log_evidence(strides, found, is_level=True)


def log_bayes_factor_of_signals(strides: Strides, found: RoadFit) -> float:
    """Of one road that moves force and signals, against a road that moves the force and signals that show none.

    Where an unmodelled force is taken for a road, its signals do not follow.
    """
    blank = np.full(len(strides), np.nan)
    hidden = replace(strides, altitude=blank, grade=blank, gravity=blank)
    return log_bayes_factor_of_road(strides, found) - log_bayes_factor_of_road(hidden, found)


def _log_evidence(strides: Strides, found: RoadFit, is_level: bool) -> float:
    """Of strides with the orders, effects and lag that were found; the scales are found again."""
    model = RoadModel(strides, found.scales.alpha, found.scales.wander)
    likelihood = Likelihood(model, found.terms, found.theta[:ROAD_LOAD], found.scales.lag)
    names = [scale.name for scale in model.scales]
    start, free = found.scales.values[: len(names)].copy(), list(range(len(names)))  # those of signals come last
    if is_level:
        slope = names.index("slope")
        start[slope] = model.scales[slope].low
        free = [i for i in free if names[i] not in ("slope", "slope length")]
    values, _ = likelihood.best_scales(start, free, UNKNOWN_SCALE_STEP)
    return likelihood.log_evidence(values)


class _Search:
    """The search for the scales, the smoothness of the road and the nearest of LAGS."""

    def __init__(self, strides: Strides, terms: Sequence[Term], road_load: Floats, longest_lag: float) -> None:
        self._strides, self._terms, self._road_load, self._longest_lag = strides, terms, road_load, longest_lag
        self._models: dict[tuple[int, int], RoadModel] = {}

    def model(self, alpha: int, wander: int) -> RoadModel:
        """The strides' model for orders of road and wander."""
        if (alpha, wander) not in self._models:
            self._models[alpha, wander] = RoadModel(self._strides, alpha, wander)
        return self._models[alpha, wander]

    def likelihood(self, scales: RoadScales) -> tuple[Likelihood, RoadScales]:
        """The likelihood that belongs to scales."""
        return Likelihood(self.model(scales.alpha, scales.wander), self._terms, self._road_load, scales.lag), scales

    def best(self, known: RoadScales | None, orders: bool) -> tuple[Likelihood, RoadScales, float]:
        """From scales ``known`` before, or from the centres of their priors; without ``orders``, of the same orders."""
        if known is None:
            model = self.model(ALPHAS[0], ROUGH)
            values = np.array([scale.centre for scale in model.scales])
            start = RoadScales(
                values=values, alpha=ALPHAS[0], wander=ROUGH, readings=model.reading_names, lag=len(LAGS) // 2
            )
            scales, evidence = self._lagged(start, UNKNOWN_SCALE_STEP)
        else:
            scales, evidence = self._lagged(known, KNOWN_SCALE_STEP)
            if not orders:
                return *self.likelihood(scales), evidence
        if scales.readings:
            others = [i for i in range(len(scales.values)) if i not in VEHICLE_SCALES]
            order = SMOOTH if scales.wander == ROUGH else ROUGH
            scales, evidence = self._better(scales, evidence, replace(scales, wander=order), others)
        for alpha in ALPHAS:
            if alpha != scales.alpha:
                scales, evidence = self._better(scales, evidence, replace(scales, alpha=alpha), ROAD_SCALES)
        return *self.likelihood(scales), evidence

    def _better(
        self, scales: RoadScales, evidence: float, other: RoadScales, changed: Sequence[int]
    ) -> tuple[RoadScales, float]:
        """The ``scales``, or those of ``other`` orders where these have more evidence once ``changed`` are found."""
        varied, found = self._improved(other, changed, UNKNOWN_SCALE_STEP)
        return (
            self._improved(varied, range(len(varied.values)), KNOWN_SCALE_STEP)
            if found > evidence
            else (scales, evidence)
        )

    def _improved(self, scales: RoadScales, free: Sequence[int], reach: float) -> tuple[RoadScales, float]:
        likelihood, _ = self.likelihood(scales)
        values, evidence = likelihood.best_scales(scales.values, free, reach)
        return replace(scales, values=values), evidence

    def _lagged(self, scales: RoadScales, reach: float) -> tuple[RoadScales, float]:
        """Scales and the nearest lag of LAGS, each given the other."""
        evidence = 0.0
        for _ in range(LAG_PASSES):
            scales, evidence = self._improved(scales, range(len(scales.values)), reach)
            likelihood, _ = self.likelihood(scales)
            beta, _, _ = likelihood.solve(likelihood.model.condition(scales.values).gram(likelihood.data))
            beta = beta / likelihood.unit
            m = 1 / float(np.clip(beta[0], 1e-6, 5e-3))
            self._road_load = np.array([beta[1] * m, beta[2] * m, m])
            left = float(np.clip(beta[LAG] * m, -LAG_SPACING, LAG_SPACING))
            wanted = np.clip(LAGS[scales.lag] + left, -self._longest_lag, self._longest_lag)
            lag = int(np.argmin(np.abs(LAGS - wanted)))
            if lag == scales.lag or abs(left) < 0.55 * LAG_SPACING:
                break
            scales, reach = replace(scales, lag=lag), KNOWN_SCALE_STEP
        return scales, evidence


def _concluded(likelihood: Likelihood, scales: RoadScales, evidence: float, rng: np.random.Generator) -> RoadFit:
    """Coefficients corrected for the noise of the torque, with all doubts in their covariance."""
    model, unit = likelihood.model, likelihood.unit
    conditioned = model.condition(scales.values)
    gram = conditioned.gram(likelihood.data)
    plain, information, _ = likelihood.solve(gram)
    noise = likelihood.noise_information(scales.values, conditioned, plain, rng)
    direction = np.linalg.solve(information, np.eye(len(plain))[0])  # of what the data say of 1/m
    share = float(direction @ noise @ direction / (direction @ information @ direction))
    noise = limited(noise, information)
    corrected = np.linalg.inv(information - noise)
    beta: Floats = corrected @ gram[1:, 0]
    shift = (beta - plain) * (CORRECTION_DOUBT if share <= MAX_NOISE_SHARE else 1.0)
    covariance: Floats = corrected @ information @ corrected + np.outer(shift, shift)
    beta, covariance = beta / unit, covariance / np.outer(unit, unit)
    covariance = with_doubt_of_form(beta, covariance, float(scales.values[4]), hidden=not scales.readings)
    residual = likelihood.data[:, 0] - likelihood.data[:, 1:] @ (beta * unit)
    n = len(model.driven)
    at_nodes, slope = model.road(conditioned.unknowns(residual))
    rises = 0.5 * (at_nodes[1:] + at_nodes[:-1]) * np.diff(model.nodes.s)
    fitted = likelihood.data[:n, 1:] @ (beta * unit) - STANDARD_GRAVITY * slope
    return RoadFit(
        beta=beta,
        covariance=covariance,
        scales=scales,
        log_evidence=evidence,
        terms=likelihood.terms,
        strides=model.driven,
        fitted=fitted,
        slope=slope,
        slope_sd=float(scales.values[4]),
        climbed=float(rises[model.nodes.joined[1:] & (rises > 0)].sum()),
        torque_share=share,
    )

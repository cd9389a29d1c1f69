"""The vehicle's parameters from strides, with the road as a state: scales by their posterior mode, then the vehicle.

The coefficients beta = [1/m, A/m, C/m, lag/m, drag/m, earlier loads ..., offsets ..., -b/m ...] are those of
`road_likelihood`, from its `normal_equations` at the scales; the doubt of the model's form (`form_doubt`) widens them.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from estimator.estimation.form_doubt import with_doubt_of_effects, with_doubt_of_form
from estimator.estimation.normal_equations import NormalEquations
from estimator.estimation.road_likelihood import LAG, Likelihood, shapes_of, taken_by
from estimator.estimation.road_search import RoadScales, Search, first_guess, scaled_by
from estimator.model.effects.effect import AtRest
from estimator.model.linear_gaussian import NotPositiveDefiniteError
from estimator.model.road import LEVEL
from estimator.model.road_scales import LENGTH, SLOPE
from estimator.model.term import Term
from estimator.signals import Floats
from estimator.strides import LAGS, Strides
from estimator.units import STANDARD_GRAVITY

PROBE_SEED = 20_041  # of the simulated noise in the correction of every fit: the same strides give the same numbers
MIN_STRIDES = 30  # strides with a known force, 30 s: with fewer there is no fit
MIN_INVERSE_MASS = 1e-6  # 1/kg, of a vehicle of 1000 t


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

    def checked(self) -> "RoadFit":
        """The fit itself.

        Raises
        ------
        FloatingPointError
            Its coefficients or their covariance are not finite.
        """
        if not (np.isfinite(self.beta).all() and np.isfinite(self.covariance).all()):
            raise FloatingPointError("the coefficients of the fit are not finite")
        return self

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
    search = _search(strides, terms, longest_lag, departures)
    if search is None:
        return None
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
    """Fit strides as `fit` does, with ``scales`` as they are.

    They are found anew where other signals show the road, or where they lie too far apart for floating point.
    """
    search = _search(strides, terms, longest_lag, departures)
    if search is None:
        return None
    if scales.readings == search.model(scales).reading_names:
        with suppress(NotPositiveDefiniteError):  # on these strides
            return _concluded(*search.given(scales), rng, rests)
    return fit(strides, rng, terms, None, longest_lag, departures, scales.alpha == LEVEL, rests)


def _search(strides: Strides, terms: Sequence[Term], longest_lag: float, departures: Sequence[float]) -> Search | None:
    """None where too few strides have a known force, or none of these accelerates."""
    driven = strides[strides.known]
    if len(driven) < MIN_STRIDES or not driven.a.any():
        return None
    return Search(strides, terms, first_guess(driven), longest_lag, departures)


def refit(
    found: RoadFit, strides: Strides, rng: np.random.Generator, terms: Sequence[Term], rests: Sequence[AtRest] = ()
) -> RoadFit:
    """Fit the ``strides`` of a fit with other terms: scales are found again, orders and the design of the road kept.

    Its equations have no changes during the drive. ``rests``: the power while the vehicle stood.
    """
    search = Search(strides, terms, found.road_load, taken=found.taken)
    return _concluded(*search.improved(found.scales), rng, rests, with_changes=False)


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

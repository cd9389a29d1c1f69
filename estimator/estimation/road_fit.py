"""Fit of the vehicle's parameters to strides, with the road as a state: scales at their posterior mode, then beta.

The coefficients beta = [1/m, A/m, C/m, lag/m, drag/m, earlier loads ..., offsets ..., -b/m ...] of `road_likelihood`
solve the `normal_equations` at the scales; `form_doubt` adds the uncertainty of the model's form.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from estimator.estimation.form_doubt import with_doubt_of_effects, with_doubt_of_form
from estimator.estimation.normal_equations import NormalEquations
from estimator.estimation.past import Past
from estimator.estimation.road_found import RoadFound
from estimator.estimation.road_likelihood import LAG, Likelihood, shapes_of, taken_by
from estimator.estimation.road_search import Search, first_guess, scaled_by
from estimator.estimation.scales import RoadScales
from estimator.model.effect_term import EffectTerm
from estimator.model.effects.effect import AtRest
from estimator.model.linear_gaussian import NotPositiveDefiniteError
from estimator.model.road import LEVEL
from estimator.model.road_nodes import References
from estimator.model.road_scales import LENGTH, SLOPE
from estimator.signals import Floats
from estimator.strides import LAGS, Strides
from estimator.units import STANDARD_GRAVITY

MIN_STRIDES = 30  # strides with a known force, 30 s: with fewer there is no fit
MIN_INVERSE_MASS = 1e-6  # 1/kg, of a vehicle of 1000 t
MAX_RELATIVE_SD = 0.4  # of 1/m by the drive alone, up to which its posterior is near a Gaussian


@dataclass(frozen=True, kw_only=True)
class RoadFit:
    """Gaussian approximation of the likelihood of beta, nuisances' priors included; see the module."""

    beta: Floats  # (p,)
    covariance: Floats  # (p, p), with the uncertainties of corrections, scales and form
    scales: RoadScales
    log_evidence: float  # with the prior of the scales, if these were searched for; NaN where a past is fitted on
    terms: tuple[EffectTerm, ...]
    strides: Strides  # those with a known force
    references: References  # of the strides or of an earlier part of them: scales and coefficients are relative to them
    fitted: Floats  # (n,) acceleration of the model, with the road [m/s^2]
    slope: Floats  # (n,) posterior mean of the slope [1] at the strides
    slope_sd: float  # expected sd of the slope along this road [1]; the sd of its process is among the scales
    slope_doubt: float  # posterior sd of the slope [1], rms over the nodes
    climbed: float  # [m], sum of all rises of the road
    equations: NormalEquations = field(repr=False)
    departures: tuple[float, ...] = ()  # times [s] before which the load may have changed
    contradicted: tuple[str, ...] = ()  # signals of the road that were left out, see `road_signals`

    def checked(self) -> "RoadFit":
        """Return this fit if it is finite.

        Raises
        ------
        FloatingPointError
            The coefficients or their covariance are not finite.
        """
        if not (np.isfinite(self.beta).all() and np.isfinite(self.covariance).all()):
            raise FloatingPointError("the coefficients of the fit are not finite")
        return self

    @property
    def mass_sd(self) -> float:
        """Relative sd of 1/m, hence of the mass; infinite where 1/m is not positive."""
        sd = float(np.sqrt(max(self.covariance[0, 0], 0.0)))
        return sd / float(self.beta[0]) if self.beta[0] > 0 else np.inf

    @property
    def determines_mass(self) -> bool:
        """True if the drive alone determines the mass."""
        return self.mass_sd <= MAX_RELATIVE_SD

    @property
    def theta(self) -> Floats:
        """Parameters (4 + effects,): A [N], C [N s^2/m^2], m [kg], lag [s] and the effects' magnitudes."""
        return theta_of(self.beta, len(self.terms))

    @property
    def road_load(self) -> Floats:
        """Road load [A, C, m] (3,) that effects and priors scale with, see `scaled_by`."""
        return scaled_by(self.beta)

    @property
    def force(self) -> Floats:
        """Measured force (n,) [N], its power taken later by the lag of the scales."""
        aligned: Floats = self.strides.force[:, self.scales.lag]
        return aligned

    @cached_property
    def taken(self) -> Floats:
        """Force (n,) [N] of the terms, without those computed from the acceleration."""
        return taken_by(self.strides, self.force, self.road_load, self.terms, self.theta[LAG + 1 :])

    @property
    def lag(self) -> float:
        """Lag of power behind speed [s]."""
        return float(LAGS[self.scales.lag] + self.beta[LAG] / self.beta[0])

    def theta_covariance(self) -> Floats:
        """Return the covariance (4 + effects, 4 + effects) of `theta`, to first order."""
        jacobian = theta_jacobian(self.beta, len(self.terms))
        spread: Floats = jacobian @ self.covariance @ jacobian.T
        return spread

    def mixed(self, shift: Floats, covariance: Floats) -> "RoadFit":
        """Return a copy with ``shift`` (b,) and ``covariance`` (b, b) added to those of the first b coefficients."""
        b, beta, wider = len(shift), self.beta.copy(), self.covariance.copy()
        beta[:b] += shift
        wider[:b, :b] += covariance
        return replace(self, beta=beta, covariance=wider)

    @property
    def slope_length(self) -> float:
        """Correlation length of the slope [m]; on a designed road, at the mean warping of the drive.

        A drive determines sd^2 / length^(2 nu) of a process of smoothness nu well (Zhang 2004), but sd and length
        badly. So the length is rescaled from the sd of the process to `slope_sd`.
        """
        nu = max(self.scales.alpha, 1) - 0.5
        ratio = self.slope_sd / float(self.scales.values[SLOPE])
        length = self.scales.values[LENGTH] / self.scales.warping(self.strides.speed).mean()
        return float(length * ratio ** (1 / nu))

    @property
    def residual_power(self) -> Floats:
        """Residual power (n,) [W] of the model with the road, measured less fitted, at the strides."""
        left: Floats = (self.fitted - self.strides.a) / float(self.beta[0]) * self.strides.speed
        return left


def theta_of(beta: Floats, effects: int) -> Floats:
    """Return A, C, m, lag and magnitudes (4 + effects,) from coefficients (p,)."""
    m = 1 / beta[0]
    return np.concatenate([[beta[1] * m, beta[2] * m, m, beta[LAG] * m], -beta[len(beta) - effects :] * m])


def theta_jacobian(beta: Floats, effects: int) -> Floats:
    """Return the Jacobian (4 + effects, p) of `theta_of`."""
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
    terms: Sequence[EffectTerm] = (),
    known: RoadScales | None = None,
    longest_lag: float = float(LAGS.max()),
    departures: Sequence[float] = (),
    level: bool = False,
    rests: Sequence[AtRest] = (),
) -> RoadFit | None:
    """Fit strides with the most probable scales of road and noise.

    Returns None if too few strides have a known force, or if the acceleration of all of these is zero (frozen speed).

    Parameters
    ----------
    strides
        All strides, with and without known force, in order of time.
    terms
        Effects beyond the road load.
    known
        Scales of an earlier fit, to start from.
    longest_lag
        Largest lag of power behind speed that is tried [s].
    departures
        Times [s] before which the load may have changed; the mass is that after the last of them.
    level
        True if a search without ``known`` scales has a level road.
    rests
        Measured power while the vehicle stood.
    """
    search = search_of(strides, terms, longest_lag, departures)
    return None if search is None else _concluded(*_searched(search, strides, known, level), rests)


def most_probable_scales(strides: Strides, known: RoadScales | None, longest_lag: float) -> RoadScales | None:
    """Return the scales that `fit` finds without effects, under one load."""
    search = search_of(strides, (), longest_lag)
    return None if search is None else _searched(search, strides, known, level=False)[1]


def _searched(
    search: Search, strides: Strides, known: RoadScales | None, level: bool
) -> tuple[Likelihood, RoadScales, float]:
    """Return the outcome of a search that starts from the ``known`` scales where these are of the same signals."""
    if known is not None:
        known = known.at(search.point)
        here = tuple(place for place in known.turns if strides.s0[0] < place[1] and place[0] < strides.s1[-1])
        known = replace(known, turns=here) if known.readings == search.model(known).reading_names else None
    return search.best(known, level)


def fit_given(
    strides: Strides,
    scales: RoadScales,
    terms: Sequence[EffectTerm] = (),
    longest_lag: float = float(LAGS.max()),
    departures: Sequence[float] = (),
    rests: Sequence[AtRest] = (),
) -> RoadFit | None:
    """Fit strides as `fit` does, but with fixed ``scales``.

    Scales are searched anew if other signals show the road, or if they differ too much for floating point.
    """
    search = search_of(strides, terms, longest_lag, departures)
    if search is None:
        return None
    if scales.readings == search.model(scales).reading_names:
        with suppress(NotPositiveDefiniteError):  # on these strides
            return _concluded(*search.given(scales), rests)
    return fit(strides, terms, None, longest_lag, departures, scales.alpha == LEVEL, rests)


def search_of(
    strides: Strides,
    terms: Sequence[EffectTerm] = (),
    longest_lag: float = float(LAGS.max()),
    departures: Sequence[float] = (),
) -> Search | None:
    """Return the search over strides, or None under the conditions of `fit`."""
    driven = strides[strides.known]
    if len(driven) < MIN_STRIDES or not driven.a.any():
        return None
    return Search(strides, terms, first_guess(driven), longest_lag, departures)


def refit(
    found: RoadFit,
    strides: Strides,
    terms: Sequence[EffectTerm],
    rests: Sequence[AtRest] = (),
) -> RoadFit:
    """Fit the ``strides`` of a fit with other terms: scales are refitted; orders and design of the road are kept.

    Its equations have no changes of force. ``rests`` is the power while the vehicle stood.
    """
    search = Search(strides, terms, found.road_load, taken=found.taken)
    return _concluded(*search.improved(found.scales), rests, with_changes=False)


def _beside(
    rest: AtRest, beta: Floats, covariance: Floats, terms: Sequence[EffectTerm]
) -> tuple[Floats, Floats, float]:
    """Update coefficients (p,) and covariance with the power at rest; return both and its log predictive density.

    The power at rest is the sum over ``terms``. The update is a Kalman filter's, to first order.
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
    rests: Sequence[AtRest],
    with_changes: bool = True,
) -> RoadFit:
    """Return the fit at ``scales``: coefficients, their covariance with all uncertainties, and the road given them."""
    present = likelihood.model.driven.t >= max(likelihood.departures, default=-np.inf)
    shapes = shapes_of(present)[:, : None if with_changes else 0]
    equations = NormalEquations.of(likelihood, scales.values, scales.free, scales.power_chance, shapes)
    return solved(likelihood, scales, evidence, rests, equations)


def solved(
    likelihood: Likelihood,
    scales: RoadScales,
    evidence: float,
    rests: Sequence[AtRest],
    equations: NormalEquations,
    past: Past | None = None,
    driven: Strides | None = None,
) -> RoadFit:
    """Return the fit that solves ``equations``, to the ``driven`` strides of the likelihood and of its past."""
    model, unit = likelihood.model, likelihood.unit
    beta, covariance, _ = equations.solve()
    beta, covariance = beta / unit, covariance / np.outer(unit, unit)
    for rest in rests:
        beta, covariance, gain = _beside(rest, beta, covariance, likelihood.terms)
        evidence += gain
    covariance = with_doubt_of_effects(beta, covariance, len(likelihood.terms))
    weights = np.append(1.0, -beta * unit)[:, None]
    conditioned, _ = likelihood.at(scales.values)
    road = RoadFound.of(likelihood, scales.values, weights, conditioned.means(likelihood.data, weights))
    if past is not None:
        road = past.road.followed_by(road, weights)
    driven = model.driven if driven is None else driven
    at_nodes, slope = road.slope[:, 0], road.under[:, 0]
    rises = 0.5 * (at_nodes[1:] + at_nodes[:-1]) * np.diff(road.s)
    slope_doubt = float(np.sqrt(np.mean(road.variance)))
    slope_sd = float(np.hypot(np.std(at_nodes), slope_doubt))
    covariance = with_doubt_of_form(beta, covariance, slope_sd, hidden=not scales.readings)
    return RoadFit(
        beta=beta,
        covariance=covariance,
        scales=scales,
        log_evidence=evidence,
        terms=likelihood.terms,
        strides=driven,
        references=model.references,
        fitted=driven.a - road.residual[:, 0] - STANDARD_GRAVITY * slope,
        slope=slope,
        slope_sd=slope_sd,
        slope_doubt=slope_doubt,
        climbed=float(rises[road.joined[1:] & (rises > 0)].sum()),
        equations=equations,
        departures=likelihood.departures,
    )

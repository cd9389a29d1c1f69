"""The fit behind the posterior: moments that noise in the regressors does not bias.

Model: P = X theta + e with columns X = [v, v^3, v a, -dP] and theta = [A, C, m, tau]; the nuisance tau [s] is what
is left of the lag between power and speed, to first order.

Noise of the wheel speed sits in X, so least squares is biased towards a light vehicle with more friction. The
instruments Z are the same columns from readings that surround the sample without touching it; their noise is
independent of the sample's, so the moments

    g(theta) = Z' (P - X theta)

have mean zero at the true theta, whatever the noise of the sensors. Samples are selected by the model power that the
*instruments* predict: a selection by measured power would depend on its noise and bias the fit.

The covariance S of the moments has to allow for residuals that stay on one side for seconds. It is the average of
the lowest B cosine transforms of Z e (equal-weighted cosines: Mueller 2004; Lazarus, Lewis, Stock, Watson 2018),
which makes the estimate t-distributed with B degrees of freedom. The posterior combines exp(-g' S^-1 g / 2)
(Chernozhukov & Hong 2003) with a Gaussian prior of the nuisance.
"""

from dataclasses import dataclass

import numpy as np
from scipy.fft import next_fast_len

from estimator.model.design_matrix import Term, best_terms, columns
from estimator.model.effects import Effect
from estimator.samples import Samples
from estimator.signals import Floats, Mask

MAX_PASSES = 8  # alternations of fit and selection of samples; they stop when the selection stays the same
MIN_COSINES = 12  # degrees of freedom of the covariance: fewer would give a t density without usable tails
BLOCK_SAMPLES = 20  # samples, 2 s: beyond the reach of the smoother
TIMES_PER_COSINE = 4.0  # autocorrelation times that one cosine transform must span
LAG_SD = 0.1  # s, sd of the prior of the lag that the coarse alignment leaves
ROAD_LOAD = 3  # the first parameters
PARAMETERS = 4  # with the lag
EFFECT_PASSES = 3  # fits: effects scale with the road load of the fit before
MIN_SAMPLES_FOR_EFFECTS = 600  # 1 min of samples
MIN_SAMPLES_PER_COLUMN = 20  # samples, 2 s, for each column: with fewer there is no fit


@dataclass(frozen=True)
class Belief:
    """What is known before the data, as a Gaussian in information form: ``precision`` (p, p) and precision @ mean.

    Beliefs from independent sources add up.
    """

    precision: Floats
    moment: Floats

    def __add__(self, other: "Belief") -> "Belief":
        return Belief(self.precision + other.precision, self.moment + other.moment)

    def beside(self, terms: tuple[Term, ...], road_load: Floats) -> "Belief":
        """The same with a prior of each term's own magnitude, scaled by ``road_load`` = [A, C, m] (3,)."""
        own = [term for term in terms if not term.joins_mass]
        n = len(self.moment)
        precision = np.zeros((n + len(own), n + len(own)))
        precision[:n, :n] = self.precision
        for i, term in enumerate(own, start=n):
            precision[i, i] = term.prior_sd(road_load) ** -2
        return Belief(precision, np.concatenate([self.moment, np.zeros(len(own))]))

    @classmethod
    def about(cls, i: int, mean: float, sd: float) -> "Belief":
        """Parameter ``i`` is ``mean`` give or take ``sd``."""
        unit = np.eye(PARAMETERS)[i]
        return cls(np.outer(unit, unit) / sd**2, unit * mean / sd**2)


SMALL_LAG = Belief.about(3, 0.0, LAG_SD)


@dataclass(frozen=True, kw_only=True)
class Fit:
    """Result of the moment fit; parameters in the order A [N], C [N s^2/m^2], m [kg], tau [s]."""

    theta: Floats
    covariance: Floats
    dof: float
    kept: Mask  # samples that count
    rms: float  # [W] residual
    effective: float  # number of independent residuals
    terms: tuple[Term, ...] = ()  # effects in the model
    road_load: Floats | None = None  # A, C, m with which their columns were scaled

    def columns(self, samples: Samples) -> tuple[Floats, Floats]:
        """Regressors and instruments (n, p) of this model for ``samples``."""
        return columns(samples, self.terms, self.road_load)

    @property
    def own_terms(self) -> tuple[Term, ...]:
        """Those that have a parameter of their own, in the order of theta."""
        return tuple(term for term in self.terms if not term.joins_mass)

    @property
    def sd(self) -> Floats:
        """Standard deviation of each parameter (p,)."""
        return np.sqrt(np.diag(self.covariance))


def autocorrelation_time(x: Floats) -> float:
    """Integrated autocorrelation time [samples] of ``x`` (n,), at least 1, with Sokal's window of 5 times itself."""
    n = len(x)
    size = next_fast_len(2 * n)
    spectrum = np.fft.rfft(x - x.mean(), size)
    covariance = np.fft.irfft(np.abs(spectrum) ** 2, size)[:n]
    if covariance[0] <= 0:
        return 1.0
    tau = 2 * np.cumsum(covariance / covariance[0]) - 1
    enough = np.flatnonzero(np.arange(n) >= 5 * tau)
    return max(float(tau[enough[0]] if len(enough) else tau[-1]), 1.0)


def block_means(x: Floats, size: int) -> Floats:
    """Means (n // size,) of each ``size`` consecutive values of ``x`` (n,); the rest at the end is not used."""
    means: Floats = x[: len(x) // size * size].reshape(-1, size).mean(axis=1)
    return means


def _slow_time(residual: Floats) -> float:
    """Autocorrelation time [samples] of means over BLOCK_SAMPLES, which contain no noise of dv/dt."""
    return BLOCK_SAMPLES * autocorrelation_time(block_means(residual, BLOCK_SAMPLES))


def cosine_transform(x: Floats, count: int) -> Floats:
    """Orthonormal cosine transforms 1 .. ``count`` <= n / 2, of type II, of the columns of ``x`` (n, p).

    By the Fourier transform of the even rows followed by the odd ones backwards (Makhoul 1980). `scipy.fft` has it
    ready, but keeps tables for the last sixteen lengths, and here each length is another: 27 MB for ever.
    """
    n = len(x)
    turn = np.exp(-0.5j * np.pi * np.arange(1, count + 1) / n) * np.sqrt(2 / n)
    spectrum = np.fft.rfft(np.concatenate([x[::2], x[1::2][::-1]]), axis=0)[1 : count + 1]
    transform: Floats = (spectrum * turn[:, None]).real
    return transform


def long_run_covariance(scores: Floats, cosines: int) -> Floats:
    """Covariance (p, p) of the column sums of ``scores`` (n, p), autocorrelated as they may be."""
    transform = cosine_transform(scores, cosines)
    return len(scores) * transform.T @ transform / len(transform)


def fit(
    samples: Samples, power_sigmas: float, belief: Belief = SMALL_LAG, effects: tuple[Effect, ...] = ()
) -> Fit | None:
    """Fit all samples whose predicted power exceeds ``power_sigmas`` residual sd, given a prior ``belief``.

    Effects beyond the plain road load scale with it, so it is fitted without them first. Returns None where the
    moments do not determine the parameters: too few samples, or a drive so uniform that the columns are not
    independent.
    """
    found = _fit(samples, power_sigmas, belief, (), None)
    for _ in range(EFFECT_PASSES if effects else 0):
        if found is None or len(samples) < MIN_SAMPLES_FOR_EFFECTS:
            return None
        road_load = found.theta[:ROAD_LOAD]
        terms = best_terms(effects, samples[found.kept], road_load)
        found = _fit(samples, power_sigmas, belief.beside(terms, road_load), terms, road_load)
    return found


def _fit(
    samples: Samples, power_sigmas: float, belief: Belief, terms: tuple[Term, ...], road_load: Floats | None
) -> Fit | None:
    X, Z = columns(samples, terms, road_load)
    if len(X) < MIN_SAMPLES_PER_COLUMN * X.shape[1]:
        return None
    # Columns of order one: v^3 is 10^4 times v, and the equations would look singular for that alone.
    scale = np.sqrt(np.mean(X**2, axis=0))
    if not np.all(scale > 0):
        return None
    X, Z = X / scale, Z / scale
    prior = Belief(belief.precision / np.outer(scale, scale), belief.moment / scale)
    kept = np.ones(len(X), dtype=bool)
    driving = np.arange(X.shape[1]) != ROAD_LOAD  # all but the lag
    spread: Floats | None = None
    for _ in range(MAX_PASSES):
        if kept.sum() < MIN_SAMPLES_PER_COLUMN * X.shape[1]:
            return None
        Xk, Zk, Pk = X[kept], Z[kept], samples.P[kept]
        solution = _solve(Xk, Zk, Pk, spread, prior)
        if solution is None:
            return None
        theta, covariance = solution
        residual = Pk - Xk @ theta
        time = autocorrelation_time(residual)
        cosines = _cosines(len(Pk), _slow_time(residual), X.shape[1])
        # The fit reduces the residual's variance by its number of parameters, as in n / (n - p).
        spread = long_run_covariance(Zk * residual[:, None], cosines) * cosines / (cosines - X.shape[1])
        previous, kept = kept, Z @ (theta * driving) > power_sigmas * residual.std()
        if np.array_equal(kept, previous):
            break
    # Once more, with the spread that belongs to the final choice.
    final = _solve(Xk, Zk, Pk, spread, prior)
    if final is None:
        return None
    theta, covariance = final
    rms = float(np.sqrt(np.mean((Pk - Xk @ theta) ** 2)))
    covariance = covariance / np.outer(scale, scale)
    return Fit(
        theta=theta / scale,
        covariance=covariance,
        dof=float(cosines),
        kept=previous,
        rms=rms,
        effective=len(Pk) / time,
        terms=terms,
        road_load=road_load,
    )


def _solve(X: Floats, Z: Floats, P: Floats, spread: Floats | None, prior: Belief) -> tuple[Floats, Floats] | None:
    """Mode and covariance of the posterior; without a ``spread`` of the moments, that of white residuals."""
    cross, moment = Z.T @ X, Z.T @ P
    if spread is None:
        start = np.linalg.lstsq(X, P, rcond=None)[0]
        spread = float(np.mean((P - X @ start) ** 2)) * Z.T @ Z
    if np.linalg.cond(spread) > 1 / np.finfo(float).eps:
        return None
    weighted = np.linalg.solve(spread, np.column_stack([cross, moment]))
    information = cross.T @ weighted[:, :-1] + prior.precision
    unit = np.sqrt(np.diag(information))
    if not np.all(unit > 0) or np.linalg.cond(information / np.outer(unit, unit)) > 1 / np.finfo(float).eps ** 0.5:
        return None
    covariance = np.linalg.inv(information / np.outer(unit, unit)) / np.outer(unit, unit)
    return covariance @ (cross.T @ weighted[:, -1] + prior.moment), covariance


def _cosines(n: int, time: float, parameters: int) -> int:
    """How many cosine transforms stay below the frequency at which the residual's spectrum falls off.

    More than the ``parameters`` of the fit, which take as many degrees of freedom.
    """
    least = MIN_COSINES + max(parameters - PARAMETERS, 0)
    return int(np.clip(n / (TIMES_PER_COSINE * time), least, max(0.4 * n ** (2 / 3), least)))

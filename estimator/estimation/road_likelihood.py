"""Likelihood of strides with the road as a state, for given scales of road and noise.

The response is the acceleration, the regressors are the columns of `columns`, and the coefficients

    beta = [1/m, A/m, C/m, lag/m, drag/m, 1/m_k - 1/m ..., offsets ..., -b/m ...]

enter linearly; they are integrated over their priors. m is the mass of the present load, m_k that of an earlier one,
where a stop lies between. Noise of the measured force sits in the regressors too: `Likelihood.noise_information` gives
the rise of their products.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.sparse as sp

from estimator.model.border import Border
from estimator.model.conditioned import Conditioned
from estimator.model.effect_term import EffectTerm
from estimator.model.effects.effect import View
from estimator.model.linear_gaussian import NotPositiveDefiniteError
from estimator.model.road import RoadModel
from estimator.model.road_load import NEW_LOAD_SD
from estimator.model.road_score import Score, score
from estimator.samples import over_mean
from estimator.signals import Floats, Mask
from estimator.strides import DURATION, LAGS, Strides

ROAD_LOAD = 3  # the first coefficients
LAG, DRAG = 3, 4  # places of the nuisances
PLAIN = 5  # coefficients without loads, offsets and effects
LAG_SD = 0.15  # s, sd of the prior of the lag that the nearest of LAGS leaves
DRAG_SD = 0.03  # share by which the engine's drag at the wheels may differ from what the bus says (gearbox losses)
VAGUE = (5e-3, 1.0, 1e-2)  # prior sd of 1/m [1/kg], A/m [m/s^2], C/m [1/m]: far beyond any vehicle
MAX_CORRECTED_SHARE = 0.7  # of the information in any direction, that is subtracted as noise
PARTS = 4  # of the driving with a load, between which the force may change by a step


def earlier_loads(t: Floats, departures: Sequence[float]) -> Mask:
    """Mask (n, k) of times ``t`` (n,) [s] in each of the k non-empty loads before the last of ``departures`` [s]."""
    number = np.searchsorted(np.array(departures), t, side="right")
    mask: Mask = number[:, None] == np.unique(number[number < len(departures)])
    return mask


def shapes_of(present: Mask) -> Floats:
    """Shapes (n, PARTS) of a change in the ``present`` strides (n,): a ramp, and a step between any two parts."""
    shapes: Floats = shapes_at(np.cumsum(present) / max(int(present.sum()), 1)) * present[:, None]
    return shapes


def shapes_at(position: Floats) -> Floats:
    """`shapes_of` strides at each ``position`` (n,) in the driving with the load, which ends at 1."""
    steps = [np.where(position > k / PARTS, 0.5, -0.5) for k in range(1, PARTS)]
    shapes: Floats = np.column_stack([position - 0.5, *steps])
    return shapes


def view_of(
    strides: Strides, force: Floats, road_load: Floats, taken: Floats | float, density: Floats | None = None
) -> View:
    """Quantities that effects are computed from, for a ``force`` F (n,) [N] and the force [N] ``taken`` by effects.

    ``density`` (n,) [1] is that of the air over its mean in the fit; None: over its mean in these strides.

    The acceleration is that on level ground, (F - taken - A - C v^2) / m: the measured one includes the slope.
    """
    A, C, m = road_load.tolist()
    density = strides.relative_density if density is None else density
    return View(
        t=strides.t,
        v=strides.speed,
        a=(force - taken - A - C * density * strides.speed_squared) / m,
        P=force * strides.speed,
        density=density,
        context=strides.context,
        road_load=road_load,
        duration=DURATION,
    )


def taken_by(
    strides: Strides,
    force: Floats,
    road_load: Floats,
    terms: Sequence[EffectTerm],
    sizes: Floats,
    density: Floats | None = None,
) -> Floats:
    """Force [N] (n,) that ``terms`` of these ``sizes`` take from acceleration.

    An inertia I takes I / (m + I) of the force that accelerates. Other terms that are computed from the force or the
    acceleration take none.
    """
    view = view_of(strides, force, road_load, 0.0, density)
    total, inertia = np.zeros((2, len(strides)))
    for term, size in zip(terms, sizes.tolist(), strict=True):
        if term.effect.inertia is not None:
            inertia += max(size, 0.0) * term.effect.inertia(view)
        elif not term.effect.is_noisy:
            total += size * term.column(view) / strides.speed
    m = float(road_load[2])
    taken: Floats = total + inertia / (m + inertia) * (m * view.a - total)
    return taken


def columns(
    strides: Strides,
    lag: int,
    terms: Sequence[EffectTerm],
    road_load: Floats,
    departures: Sequence[float] = (),
    taken: Floats | float = 0.0,
    density: Floats | None = None,
) -> Floats:
    """Regressors (n, PLAIN + earlier loads + terms) of the acceleration, for force at the lag with number ``lag``.

    The load may have changed before each of the ``departures`` [s]; rolling resistance is proportional to it. What the
    terms have ``taken`` of the force [N] (n,), as far as it is known, accelerates no load. ``density``: see `view_of`.
    """
    force = strides.force[:, lag]
    low, high = max(lag - 1, 0), min(lag + 1, len(LAGS) - 1)
    rate = (strides.force[:, high] - strides.force[:, low]) / (LAGS[high] - LAGS[low])
    density = strides.relative_density if density is None else density
    plain = [force, -np.ones(len(strides)), -density * strides.speed_squared, rate, np.minimum(force, 0.0)]
    view = view_of(strides, force, road_load, taken, density)
    pulling = force - taken - float(road_load[1]) * density * strides.speed_squared
    loads = pulling[:, None] * earlier_loads(strides.t, departures)
    return np.column_stack([*plain, loads, *(term.column(view) / strides.speed for term in terms)])


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
    departures
        Times [s] before which the load may have changed.
    taken
        Force [N] (n,) that the terms take, roughly.
    border, unit
        Driving that is eliminated, and the units (p,) of the coefficients there, in which a likelihood of what is
        behind it goes on.
    """

    def __init__(
        self,
        model: RoadModel,
        terms: Sequence[EffectTerm],
        road_load: Floats,
        lag: int,
        departures: Sequence[float] = (),
        taken: Floats | float = 0.0,
        border: Border | None = None,
        unit: Floats | None = None,
    ) -> None:
        self.border = border
        self.model, self.lag, self.terms, self.departures = model, lag, tuple(terms), tuple(departures)
        self.road_load, self._taken = road_load, taken
        self._last: tuple[bytes, Conditioned, Floats] | None = None
        self._clean = X = self._columns(model.driven)
        self._plain = X.shape[1] - len(terms)  # coefficients before the offsets
        data = model.given(np.column_stack([model.driven.a, X]))
        inside = data.shape[1] - 1 - X.shape[1]  # offsets of the road's signals follow them
        plain = self._plain
        self.order = [*range(1, 1 + plain), *range(1 + X.shape[1], data.shape[1]), *range(1 + plain, 1 + X.shape[1])]
        self.data = data[:, [0, *self.order]]
        if unit is None:
            size = np.sqrt(np.mean(self.data[: len(X), 1:] ** 2, axis=0))
            unit = np.where(size > 0.0, size, 1.0)  # an engine that never drags has zeros, but not its noise
            unit[plain : plain + inside] = 1.0
        self.unit = unit
        self.data[:, 1:] /= unit
        m = float(road_load[2])
        sds = [*VAGUE, LAG_SD / m, DRAG_SD / m, *([NEW_LOAD_SD / m] * (plain - PLAIN))]
        sds += [reading.errors.offset_sd for reading in model.readings for _ in range(reading.offsets.shape[1])]
        sds += [term.prior_sd(road_load) / m for term in terms]
        self.prior = np.diag((np.array(sds) * self.unit) ** -2.0)

    def _columns(self, driven: Strides) -> Floats:
        density = over_mean(driven.density, self.model.references.density)
        return columns(driven, self.lag, self.terms, self.road_load, self.departures, self._taken, density)

    def solve(self, gram: Floats) -> tuple[Floats, Floats, float]:
        """Coefficients (p,), their information (p, p) and -2 log likelihood without log|K|; in own units."""
        information = gram[1:, 1:] + self.prior
        beta = np.linalg.solve(information, gram[1:, 0])
        return beta, information, float(gram[0, 0] - gram[1:, 0] @ beta)

    def at(self, scales: Floats) -> tuple[Conditioned, Floats]:
        """The model with ``scales`` (k,), and the gram matrix of the data; those asked for last are kept.

        Raises
        ------
        NotPositiveDefiniteError
            The scales lie too far apart for floating point.
        """
        key = scales.tobytes()
        if self._last is None or self._last[0] != key:
            conditioned = Conditioned.of(self.model, scales, self.border)
            self._last = key, conditioned, conditioned.gram(self.data)
        return self._last[1:]

    def log_evidence(self, scales: Floats) -> float:
        """Log marginal likelihood of ``scales`` (k,), coefficients integrated out, up to a constant of the model.

        Minus infinity where they lie too far apart for floating point.
        """
        try:
            conditioned, gram = self.at(scales)
        except NotPositiveDefiniteError:
            return -np.inf
        _, information, misfit = self.solve(gram)
        volume = float(np.linalg.slogdet(information)[1] - np.log(np.diag(self.prior)).sum())
        return -0.5 * (conditioned.log_determinant + volume + misfit)

    def score(self, scales: Floats) -> Score:
        """Derivative and average information of the log evidence by the logarithms of ``scales`` (k,)."""
        conditioned, gram = self.at(scales)
        beta, information, _ = self.solve(gram)
        return score(conditioned, scales, self.data, beta, information)

    def with_changes(self, shapes: Floats) -> Floats:
        """The data, with the columns of 1/m, A/m and C/m once more for each of the ``shapes`` (n, k) of a change."""
        n = len(shapes)
        changing = np.zeros((len(self.data), ROAD_LOAD * shapes.shape[1]))
        changing[:n] = _changing(self.data[:n, 1:], shapes)
        return np.column_stack([self.data, changing])

    def by_force(self, shapes: Floats) -> Floats:
        """Change (n, p + 3 k) of the regressors per unit [N] of an error of the force, without that of its rate.

        The regressors are those of `with_changes` for ``shapes`` (n, k), in the scaled units of the likelihood.
        """
        driven, p = self.model.driven, len(self.unit)
        places = np.array([*range(self._plain), *range(p - len(self.terms), p)])
        change = self._columns(replace(driven, force=driven.force + 1.0)) - self._clean
        added = np.zeros((len(driven), p))
        added[:, places] = change / self.unit[places]
        return np.column_stack([added, _changing(added, shapes)])

    def noise_information(self, conditioned: Conditioned, by_force: Floats) -> Floats:
        """Mean of dX' K^-1 dX (q, q) over the noise of the measured force on 1 kg, for changes ``by_force`` (n, q).

        It is in proportion to the square of the mass. Strides whose changes are set to zero do not count.
        """
        noise, of_rate = conditioned.torque_noise(sp.csc_array(by_force))
        noise[LAG, LAG] = float(of_rate[by_force[:, 0] != 0].sum()) / self.unit[LAG] ** 2
        return noise


def _changing(columns: Floats, shapes: Floats) -> Floats:
    """The first three of ``columns`` (n, p) times each of the ``shapes`` (n, k): (n, 3 k)."""
    product: Floats = shapes[:, :, None] * columns[:, None, :ROAD_LOAD]
    return product.reshape(len(shapes), -1)


def limited(noise: Floats, information: Floats) -> Floats:
    """The noise (p, p) in an information matrix, at most MAX_CORRECTED_SHARE of it in any direction.

    A direction with noise alone (the lag, where the force hardly changes) keeps some information.
    """
    unit, noisy = 1 / np.sqrt(np.diag(information)), np.flatnonzero(np.diag(noise))
    at, alone = np.ix_(noisy, noisy), np.eye(len(noise))[:, noisy]
    scaled = noise[at] * np.outer(unit[noisy], unit[noisy])
    # Directions outside of the noisy coefficients have no noise, so their covariance beside all others is enough.
    root = np.linalg.cholesky(np.linalg.solve(information * np.outer(unit, unit), alone)[noisy])
    shares, directions = np.linalg.eigh(root.T @ scaled @ root)
    back = np.linalg.solve(root.T, directions) / unit[noisy, None]
    kept = np.zeros_like(noise)
    kept[at] = (back * np.minimum(shares, MAX_CORRECTED_SHARE)) @ back.T
    return kept

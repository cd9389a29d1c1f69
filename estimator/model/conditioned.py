"""Road model with given scales: posterior of its unknowns, and products with the inverse covariance of the data.

The data are Y = X beta + A u + errors, with unknowns u of precision Q and errors of the variances D. Therefore

    K^-1 = D^-1 - D^-1 A (Q + A' D^-1 A)^-1 A' D^-1,   log|K| = log|D| + log|Q + A' D^-1 A| - log|Q|

(Woodbury), with K the covariance of the data. The matrix in the middle is banded.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import scipy.sparse as sp

from estimator.model.border import Border
from estimator.model.gram import Columns, gram
from estimator.model.linear_gaussian import Factor, both_triangles
from estimator.model.road import RoadModel
from estimator.signals import Floats


@dataclass(frozen=True, kw_only=True)
class _Shares:
    """Diagonals of products of K^-1 and covariances: of the accelerations by the slopes (n,) and by the torque's noise.

    ``slope_variance`` (N,) [1] is that of the slopes at the nodes, ``of_torque_rate`` (n,) is for the noise's rate.
    """

    of_slopes: Floats
    of_torque: Floats
    slope_variance: Floats
    of_torque_rate: Floats


@dataclass(frozen=True, kw_only=True)
class Conditioned:
    """Road model with given scales; K is the covariance of the data.

    With a ``border``, the driving before it is eliminated: its observations in the model have infinite variances, its
    unknowns a precision of 1.
    """

    model: RoadModel
    scales: Floats
    variance: Floats
    factor: Factor = field(repr=False)
    log_determinant: float  # log|K|
    border: Border | None = None

    @classmethod
    def of(cls, model: RoadModel, scales: Floats, border: Border | None = None) -> "Conditioned":
        """Condition a model with ``scales`` (k,), in the order of `RoadModel.scales`.

        Raises
        ------
        NotPositiveDefiniteError
            The scales lie too far apart for floating point.
        """
        variances = model.variances(scales)
        if border is not None:
            return cls._behind(model, scales, variances, border)
        precision, log_prior = model.precision(scales, variances)
        factor = Factor.of(precision)
        log_noise = float(sum(np.log(variance).sum() for variance in variances))
        return cls(
            model=model,
            scales=scales,
            variance=np.concatenate(variances),
            factor=factor,
            log_determinant=log_noise + factor.log_determinant - log_prior,
        )

    @classmethod
    def _behind(cls, model: RoadModel, scales: Floats, variances: list[Floats], border: Border) -> "Conditioned":
        """Condition the driving behind a border; the determinant is not known."""
        behind = zip(variances, border.seen_behind(model), strict=True)
        variances = [np.where(seen, variance, np.inf) for variance, seen in behind]
        precision, _ = model.precision(scales, variances)
        return cls(
            model=model,
            scales=scales,
            variance=np.concatenate(variances),
            factor=Factor.of(border.add_information(precision, model.place_at(border.t))),
            log_determinant=np.nan,
            border=border,
        )

    @cached_property
    def _shares(self) -> _Shares:
        """All that the covariance of the unknowns is needed for: it is too large to be kept."""
        model, variance = self.model, self.variance[: self.model.counts[0]]
        torque, products = model.force_noises[0], both_triangles(self.factor.covariance())
        inverse = (1 - model.motion_variance(products) / variance) / variance
        of_torque = model.shared_with_torque(products) / variance + inverse * torque.remaining(self.scales)
        of_slopes: Floats = np.zeros(len(variance))  # of a level road
        slope_variance: Floats = np.zeros(len(model.nodes.s))
        if not model.is_level:
            of_slopes, slope_variance = model.shared_with_slopes(products) / variance, model.slope_variance(products)
        rate = inverse * torque.rate_variance(self.scales)
        return _Shares(of_slopes=of_slopes, of_torque=of_torque, slope_variance=slope_variance, of_torque_rate=rate)

    @property
    def leverage(self) -> Floats:
        """Share (n,) of each driven stride's acceleration that the slopes may explain.

        It is the diagonal of the product of K^-1 and the prior covariance of the accelerations by the slopes alone. Its
        sum is the effective number of parameters of the slopes.
        """
        return self._shares.of_slopes

    @property
    def slope_variance(self) -> Floats:
        """Posterior variance (N,) [1] of the slope at each node of the road, given the parameters."""
        return self._shares.slope_variance

    def torque_noise(self, by_torque: sp.csc_array) -> tuple[Floats, Floats]:
        """Mean products d' K^-1 d of columns that noise of the torque, as an acceleration, changes by d.

        Returns those (c, c) of columns that change by ``by_torque`` (n, c) times it, and the part (n,) of each stride
        in that of its rate. With S its covariance and G = ``by_torque``, they are sum_i (K^-1 S)_ii G_i G_i', which is
        exact where G is constant. Where G changes from stride to stride, the squares of 30 columns of a diagnosis are
        within 3 % of simulated ones; that of the rate, which is taken as white, is within 12 %.
        """
        products: Floats = (by_torque.T @ by_torque.multiply(self._shares.of_torque[:, None])).toarray()
        return products, self._shares.of_torque_rate

    def gram(self, data: Columns) -> Floats:
        """Y' K^-1 Y (c, c) of data columns; with a border, the first of those eliminated there, and dense."""
        if self.border is None:
            return gram(self.factor, self.model.kinds, self.variance, data)
        assert isinstance(data, np.ndarray)
        count, whitened = data.shape[1], self.whitened(data)
        products: Floats = data.T @ (data / self.variance[:, None]) - whitened.T @ whitened
        return products + self.border.products[:count, :count]

    def whitened(self, data: Floats) -> Floats:
        """Rows W (size, c) of data columns (sum of counts, c): F W = A' R^-1 Y, see `gram`."""
        return self.factor.whiten(self._gathered(data / self.variance[:, None], np.eye(data.shape[1])))

    def _gathered(self, weighed: Floats, weights: Floats) -> Floats:
        """A' R^-1 Y W (size, d) of ``weighed`` R^-1 Y W (sum of counts, d), for ``weights`` W (c, d) of the columns."""
        rows = self.model.gathered(weighed)
        if self.border is not None:
            begin, before = self.model.place_at(self.border.t), self.border.rows[:, : len(weights)]
            rows[begin : begin + len(before)] += before @ weights
        return rows

    def means(self, data: Floats, weights: Floats) -> Floats:
        """Posterior mean (size, d) of all unknowns, given columns ``data`` (sum of counts, c) times weights (c, d).

        The means of unknowns before a border are zero.
        """
        return self.factor.solve(self._gathered(data @ weights / self.variance[:, None], weights))

    def unknowns(self, residual: Floats) -> Floats:
        """Posterior mean (size,) of all unknowns, given the data less X beta (sum of counts,), without a border."""
        solved: Floats = self.factor.solve(self.model.gathered((residual / self.variance)[:, None]))[:, 0]
        return solved

    def weighed(self, residual: Floats) -> Floats:
        """K^-1 times a residual (sum of counts,)."""
        rest: Floats = (residual - self.model.observed(self.unknowns(residual))) / self.variance
        return rest

    def draws(self, residuals: Floats, rng: np.random.Generator) -> Floats:
        """Draw all unknowns (size, d) from their posterior, once for each column of residuals (sum of counts, d)."""
        mean = self.factor.solve(self.model.gathered(residuals / self.variance[:, None]))
        drawn: Floats = mean + self.factor.unwhiten(rng.standard_normal(mean.shape))
        return drawn

"""Road model with given scales: posterior of its unknowns, and products with the inverse covariance of the data.

The data are Y = X beta + A u + errors, with unknowns u of precision Q and errors of the variances D. Therefore

    K^-1 = D^-1 - D^-1 A (Q + A' D^-1 A)^-1 A' D^-1,   log|K| = log|D| + log|Q + A' D^-1 A| - log|Q|

(Woodbury), with K the covariance of the data. The matrix in the middle is banded.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from estimator.model.gram import Rows, gram
from estimator.model.linear_gaussian import Factor, both_triangles
from estimator.model.road import RoadModel
from estimator.signals import Floats

TOGETHER = 16  # draws that are made at once: bounds the memory beside the draws themselves


@dataclass(frozen=True, kw_only=True)
class Conditioned:
    """Road model with given scales; K is the covariance of the data."""

    model: RoadModel
    scales: Floats
    variance: Floats
    factor: Factor = field(repr=False)
    log_determinant: float  # log|K|

    @classmethod
    def of(cls, model: RoadModel, scales: Floats) -> "Conditioned":
        """Condition a model with ``scales`` (k,), in the order of `RoadModel.scales`.

        Raises
        ------
        NotPositiveDefiniteError
            The scales lie too far apart for floating point.
        """
        variances = model.variances(scales)
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

    @cached_property
    def _moments(self) -> tuple[Floats, Floats, Floats, float]:
        """`leverage` (n,), `slope_variance` (N,), `torque_leverage` (n,) and `rate_information`."""
        model, scales, n = self.model, self.scales, self.model.counts[0]
        variance, products = self.variance[:n], both_triangles(self.factor.covariance())
        inverse = (1 - model.motion_variance(products) / variance) / variance  # diagonal of K^-1
        of_torque = model.shared_with_torque(products) / variance + inverse * model.torque_variance(scales)
        rates = float(inverse @ model.torque_rate_variance(scales))
        if model.is_level:
            return np.zeros(n), np.zeros(len(model.nodes.s)), of_torque, rates
        return model.shared_with_slopes(products) / variance, model.slope_variance(products), of_torque, rates

    @property
    def leverage(self) -> Floats:
        """Share (n,) of each driven stride's acceleration that the slopes may explain.

        It is the diagonal of the product of K^-1 and the prior covariance of the accelerations by the slopes alone. Its
        sum is the effective number of parameters of the slopes.
        """
        return self._moments[0]

    @property
    def slope_variance(self) -> Floats:
        """Posterior variance (N,) [1] of the slope at each node of the road, given the parameters."""
        return self._moments[1]

    @property
    def torque_leverage(self) -> Floats:
        """Share (n,) of each driven stride's acceleration that noise of the torque may explain, like `leverage`."""
        return self._moments[2]

    @property
    def rate_information(self) -> float:
        """Sum over the driven strides of (K^-1)_ii times the variance [m^2/s^6] of the rate of the torque's noise."""
        return self._moments[3]

    def gram(self, data: Rows) -> Floats:
        """Y' K^-1 Y (c, c) of data columns."""
        return gram(self.factor, self.model.kinds, self.variance, data)

    def unknowns(self, residual: Floats) -> Floats:
        """Posterior mean (size,) of all unknowns, given the data less X beta (sum of counts,)."""
        solved: Floats = self.factor.solve(self.model.gathered((residual / self.variance)[:, None]))[:, 0]
        return solved

    def weighed(self, residual: Floats) -> Floats:
        """K^-1 times a residual (sum of counts,), or several (sum of counts, d)."""
        columns = residual.reshape(len(residual), -1)
        unknowns = self.factor.solve(self.model.gathered(columns / self.variance[:, None]))
        rest: Floats = (columns - self.model.observed(unknowns)) / self.variance[:, None]
        return rest.reshape(residual.shape)

    def draws(self, residuals: Floats, rng: np.random.Generator) -> Floats:
        """Draw all unknowns (size, d) from their posterior, once for each column of residuals (sum of counts, d)."""
        drawn = rng.standard_normal((self.model.size, residuals.shape[1]))
        for first in range(0, residuals.shape[1], TOGETHER):
            some = slice(first, first + TOGETHER)
            mean = self.factor.solve(self.model.gathered(residuals[:, some] / self.variance[:, None]))
            drawn[:, some] = mean + self.factor.unwhiten(drawn[:, some])
        return drawn

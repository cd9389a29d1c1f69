"""Processes among the unknowns of a road model, and the noise of the measured force that is one of them.

Noise of the force has values at both ends of a stride, which are unknowns. Its mean over the stride differs from what
these give by noise of its own.
"""

from dataclasses import dataclass

import numpy as np

from estimator.model.matern import MaternField
from estimator.model.ornstein_uhlenbeck import Chain, mean_given_ends, mean_given_ends_by_time
from estimator.signals import Floats
from estimator.strides import DURATION


@dataclass(frozen=True, kw_only=True)
class Acting:
    """Process among the unknowns, with the scales that it is conditioned with.

    ``sd`` is its standard deviation and ``memory`` its correlation time [s] or length [m]. ``by`` (2, k) is the
    derivative of the logarithms of both by those of the scales.
    """

    process: Chain | MaternField
    sd: float
    memory: float
    by: Floats


@dataclass(frozen=True)
class ForceNoise:
    """Ornstein-Uhlenbeck noise of the measured force over the mass, with ``share`` (n,) of it in each driven stride.

    ``at`` is the place of its standard deviation [m/s^2] among the scales; its correlation time [s] follows.
    """

    at: int
    share: Floats

    def remaining(self, scales: Floats) -> Floats:
        """Variance [m^2/s^4] (n,) of its mean over each stride, given its values at both ends."""
        _, variance = mean_given_ends(DURATION, scales[self.at + 1])
        remaining: Floats = (scales[self.at] * self.share) ** 2 * variance
        return remaining

    def remaining_by(self, scales: Floats) -> Floats:
        """Derivatives (n, 2) of `remaining` by the logarithms of sd and time."""
        (_, variance), (_, turned) = (
            f(DURATION, scales[self.at + 1]) for f in (mean_given_ends, mean_given_ends_by_time)
        )
        return np.outer((scales[self.at] * self.share) ** 2, [2 * variance, turned])

    def rate_variance(self, scales: Floats) -> Floats:
        """Variance [m^2/s^6] (n,) of its rate over each stride, between its ends."""
        keep = np.exp(-DURATION / scales[self.at + 1])
        variance: Floats = 2 * (1 - keep) * (scales[self.at] * self.share / DURATION) ** 2
        return variance

    def acting(self, process: Chain, scales: Floats) -> Acting:
        """The ``process`` of its mean over a stride, as far as its values at the ends give it."""
        unit, time = np.eye(len(scales)), scales[self.at + 1]
        weight, _ = mean_given_ends(DURATION, time)
        turned = mean_given_ends_by_time(DURATION, time)[0] * unit[self.at + 1]
        by = np.array([unit[self.at] + turned, unit[self.at + 1]])
        return Acting(process=process, sd=2 * weight * scales[self.at], memory=time, by=by)

"""The posterior density of A, C, m and effects' magnitudes when the road is a state.

The likelihood is Gaussian in beta = (1/m, A/m, C/m, -b/m ...), see `road_fit`; beliefs are Gaussian in the parameters
themselves, and the box bounds them. So the posterior is no Gaussian, and is sampled.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from estimator.estimation.belief import Belief
from estimator.estimation.road_fit import RoadFit
from estimator.estimation.road_likelihood import PLAIN, ROAD_LOAD
from estimator.sampling.likelihood import bound_precision, factor, highest_in_box, in_box
from estimator.signals import Floats

PASSES = 6  # Newton steps to the mode


@dataclass(frozen=True, kw_only=True)
class RoadTarget:
    """Log density over theta = [A, C, m, b ...] (p,), all lags and offsets integrated out.

    Parameters
    ----------
    mean, precision
        Of the coefficients [1/m, A/m, C/m, -b/m ...] by the drive.
    belief
        About all of theta, in information form.
    lower, upper
        Bounds of the box prior.
    """

    mean: Floats
    precision: Floats
    belief: Belief
    lower: Floats
    upper: Floats

    @classmethod
    def of(cls, fit: RoadFit, belief: Belief, lower: Floats, upper: Floats) -> "RoadTarget":
        """Make the target of a fit, a prior ``belief`` about [A, C, m], and bounds (p,) of the box."""
        effects = len(fit.terms)
        places = [*range(ROAD_LOAD), *range(len(fit.beta) - effects, len(fit.beta))]
        assert len(fit.beta) - effects >= PLAIN
        covariance = fit.covariance[np.ix_(places, places)]
        size = ROAD_LOAD + effects
        precision, moment = np.zeros((size, size)), np.zeros(size)
        precision[:ROAD_LOAD, :ROAD_LOAD] = belief.precision
        moment[:ROAD_LOAD] = belief.moment
        unit = np.sqrt(np.diag(covariance))
        inverse = np.linalg.inv(covariance / np.outer(unit, unit)) / np.outer(unit, unit)
        return cls(mean=fit.beta[places], precision=inverse, belief=Belief(precision, moment), lower=lower, upper=upper)

    def _coefficients(self, theta: Floats) -> Floats:
        m = theta[:, 2]
        return np.column_stack([1 / m, theta[:, 0] / m, theta[:, 1] / m, -theta[:, ROAD_LOAD:] / m[:, None]])

    def _jacobian(self, theta: Floats) -> Floats:
        """Derivative (p, p) of the coefficients at one theta (p,)."""
        m, p = theta[2], len(theta)
        jacobian = np.zeros((p, p))
        jacobian[:, 2] = -self._coefficients(theta[None])[0] / m
        jacobian[1, 0] = jacobian[2, 1] = 1 / m
        for i in range(ROAD_LOAD, p):
            jacobian[i, i] = -1 / m
        return jacobian

    @cached_property
    def _mode(self) -> tuple[Floats, Floats]:
        """Mode of the density without the box, and its precision there, by Gauss-Newton."""
        m = 1 / max(float(self.mean[0]), 1e-9)
        theta = np.array([self.mean[1] * m, self.mean[2] * m, m, *(-self.mean[ROAD_LOAD:] * m)])
        precision = np.eye(len(theta))
        for _ in range(PASSES):
            jacobian = self._jacobian(theta)
            precision = jacobian.T @ self.precision @ jacobian + self.belief.precision
            left = self.mean - self._coefficients(theta[None])[0]
            slope = jacobian.T @ self.precision @ left + self.belief.moment - self.belief.precision @ theta
            theta = theta + np.linalg.solve(precision, slope)
            theta[2] = max(theta[2], 1.0)
        return theta, precision

    @property
    def free_mode(self) -> Floats:
        """Mode (p,) of the density without the box."""
        return self._mode[0]

    @property
    def free_sd(self) -> Floats:
        """Standard deviations (p,) at `free_mode`."""
        return np.sqrt(np.diag(np.linalg.inv(self._mode[1])))

    @cached_property
    def centre(self) -> Floats:
        """See `Target.centre`."""
        theta, precision = self._mode
        return highest_in_box(precision, theta, self.lower, self.upper)

    @cached_property
    def _curvature(self) -> Floats:
        theta, precision = self._mode
        slope = precision @ (theta - self.centre)
        root = np.linalg.inv(factor(precision + bound_precision(self.centre, slope, self.lower, self.upper)))
        return root.T @ root

    def log_density(self, theta: Floats) -> Floats:
        """See `Target.log_density`."""
        inside = in_box(theta, self.lower, self.upper)
        safe = np.where(inside[:, None], theta, self.centre)
        left = self._coefficients(safe) - self.mean
        misfit = np.einsum("ij,jk,ik->i", left, self.precision, left)
        known = np.einsum("ij,jk,ik->i", safe, self.belief.precision, safe) - 2 * safe @ self.belief.moment
        return np.where(inside, -0.5 * (misfit + known), -np.inf)

    def curvature(self, theta: Floats) -> Floats:
        """See `Target.curvature`; the same everywhere."""
        return np.broadcast_to(self._curvature, (len(theta), *self._curvature.shape))

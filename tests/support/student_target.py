"""A density with heavier tails than a Gaussian, for tests of the sampler."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from estimator.sampling.likelihood import bound_precision, factor, highest_in_box, in_box
from estimator.signals import Floats


@dataclass(frozen=True, kw_only=True)
class StudentTarget:
    """Multivariate t around a point ``fitted`` (p,), which may lie outside the box.

    log p = -(dof + p) / 2 log(1 + d' V^-1 d / dof),  d = theta - fitted
    """

    fitted: Floats
    covariance: Floats
    dof: float
    lower: Floats
    upper: Floats

    @cached_property
    def _whiten(self) -> Floats:
        """W (p, p) with W' W = V^-1."""
        return np.linalg.inv(factor(self.covariance))

    @cached_property
    def centre(self) -> Floats:
        """See `Target.centre`."""
        return highest_in_box(self._whiten.T @ self._whiten, self.fitted, self.lower, self.upper)

    @cached_property
    def _curvature(self) -> Floats:
        precision = self._whiten.T @ self._whiten
        away = self.centre - self.fitted
        slope = -(self.dof + len(away)) / (self.dof + away @ precision @ away) * (precision @ away)
        precision = precision + bound_precision(self.centre, slope, self.lower, self.upper)
        root = np.linalg.inv(factor(precision))
        return root.T @ root

    def log_density(self, theta: Floats) -> Floats:
        """See `Target.log_density`."""
        scaled = (theta - self.fitted) @ self._whiten.T
        distance = np.einsum("ij,ij->i", scaled, scaled)
        density = -0.5 * (self.dof + len(self.fitted)) * np.log1p(distance / self.dof)
        return np.where(in_box(theta, self.lower, self.upper), density, -np.inf)

    def curvature(self, theta: Floats) -> Floats:
        """See `Target.curvature`; the same everywhere."""
        return np.broadcast_to(self._curvature, (len(theta), *self._curvature.shape))

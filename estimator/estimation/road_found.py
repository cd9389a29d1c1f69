"""The road of a fit, and what the parameters leave of the acceleration."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.road_likelihood import Likelihood
from estimator.signals import Floats, Mask


@dataclass(frozen=True, kw_only=True)
class RoadFound:
    """Posterior of the road under a drive, for c weightings of the columns of its data.

    At the nodes, ``s`` (N,) [m], whether they are ``joined`` (N,) to the one before, and the mean ``slope`` (N, c) and
    ``variance`` (N,) [1] of the slope. At the driven strides, the slope ``under`` (n, c) [1] and the ``residual``
    (n, c) [m/s^2], in which the slope is not yet taken away.
    """

    s: Floats
    joined: NDArray[np.bool_]
    slope: Floats
    variance: Floats
    under: Floats
    residual: Floats

    @classmethod
    def of(cls, likelihood: Likelihood, scales: Floats, weights: Floats, unknowns: Floats) -> "RoadFound":
        """The road of a likelihood at its ``scales``, behind its border, for ``weights`` (1 + p, c) of the columns.

        ``unknowns`` (size, c) is their posterior mean.
        """
        model, (conditioned, _) = likelihood.model, likelihood.at(scales)
        n, nodes = len(model.driven), model.nodes
        at_nodes, under = model.road(unknowns)
        begin = 0 if likelihood.border is None else model.place_at(likelihood.border.t)
        whole = cls(
            s=nodes.s,
            joined=nodes.joined,
            slope=at_nodes,
            variance=conditioned.slope_variance,
            under=under,
            residual=likelihood.data[:n] @ weights,
        )
        return whole.of_those(model.nodes_behind(begin), np.isfinite(conditioned.variance[:n]))

    def of_those(self, nodes: Mask, strides: Mask) -> "RoadFound":
        """The road at some of the ``nodes`` (N,) and ``strides`` (n,)."""
        return RoadFound(
            s=self.s[nodes],
            joined=self.joined[nodes],
            slope=self.slope[nodes],
            variance=self.variance[nodes],
            under=self.under[strides],
            residual=self.residual[strides],
        )

    def followed_by(self, other: "RoadFound", weights: Floats) -> "RoadFound":
        """The road for ``weights`` (c, d) of its c weightings, and ``other``, for d weightings, behind it."""
        return RoadFound(
            s=np.concatenate([self.s, other.s]),
            joined=np.concatenate([self.joined, other.joined]),
            slope=np.concatenate([self.slope @ weights, other.slope]),
            variance=np.concatenate([self.variance, other.variance]),
            under=np.concatenate([self.under @ weights, other.under]),
            residual=np.concatenate([self.residual @ weights, other.residual]),
        )

"""An Ornstein-Uhlenbeck process at given times as a Gaussian Markov chain: stationary noise with a memory."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.model.linear_gaussian import Places
from estimator.signals import Floats


@dataclass(frozen=True)
class Chain:
    """Times [s] (n,) of a process at ``places`` among the unknowns; ``linked`` (n - 1,) where it goes on.

    Between linked neighbours the correlation is exp(-dt / time); links of different stretches are independent.
    """

    t: Floats
    places: Places
    linked: NDArray[np.bool_]

    def add_precision(self, target: Floats, sd: float, time: float) -> float:
        """Add the precision for a standard deviation and a correlation ``time`` [s] to a band; returns log|Q|.

        x_k given x_(k-1) is N(rho x_(k-1), sd^2 (1 - rho^2)).
        """
        variance = sd**2
        keep = np.where(self.linked, np.exp(-np.diff(self.t) / time), 0.0)
        innovation = 1 / (variance * (1 - keep**2))
        diagonal = np.full(len(self.t), 1 / variance)
        diagonal[1:] = innovation
        diagonal[:-1] += keep**2 * innovation
        target[0, self.places] += diagonal
        on = np.flatnonzero(self.linked)
        before, after = self.places[on], self.places[on + 1]
        target[after - before, before] -= (keep * innovation)[on]
        return float(-len(self.t) * np.log(variance) - np.log1p(-(keep**2)).sum())


def mean_given_ends(length: float, time: float) -> tuple[float, float]:
    """How the mean over ``length`` [s] of such a process of variance 1 follows from its values at both ends.

    The mean is w (x_0 + x_1) plus independent noise of variance r: returns (w, r). From the moments of the process
    and its integral; w = tanh(u / 2) / u with u = length / time.
    """
    u = length / time
    keep = np.exp(-u)
    weight = float(np.tanh(u / 2) / u)
    own = 2 * (u - 1 + keep) / u**2
    with_end = (1 - keep) / u
    return weight, float(max(own - 2 * with_end**2 / (1 + keep), 1e-12))

"""Simulated power on a cycle, and the paper's estimate from it."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from estimator.estimation.window import Grid
from estimator.model.road_load import design, power
from estimator.sampling.clipped import ClippedGaussianTarget
from estimator.sampling.metropolis import REFRESH, random_walk
from estimator.sampling.run import run
from estimator.signals import Floats, Mask
from paper.cycles import Cycle
from paper.vehicles import LOWER, UPPER

CHAINS = 3
ITERATIONS = 10_000
BURN_IN = 5_000
POWER_RESOLUTION = 1.0  # W, smallest sigma of the paper's schedule; without noise it would shrink for ever
GRID = Grid(speed_step=2.5, acceleration_step=0.1)


@dataclass(frozen=True)
class Drive:
    """Speed ``v`` [m/s], acceleration ``a`` [m/s^2] and power ``P`` [W], measured where it is above zero."""

    v: Floats
    a: Floats
    P: Floats

    @classmethod
    def of(cls, cycle: Cycle, theta: Floats, noise: float = 0.0, seed: tuple[int, ...] = (0,)) -> "Drive":
        """Power of the model with ``theta`` = [A, C, m] (3,), and Gaussian noise of sd ``noise`` [W]."""
        P = power(cycle.v, cycle.a, theta)
        return cls(cycle.v, cycle.a, P + noise * np.random.default_rng(seed).standard_normal(len(P)))

    def positive(self) -> "Drive":
        """Keep the paper's samples: measured power above zero, while the vehicle moves."""
        return self._where((self.P > 0) & (self.v > 0))

    def above_noise(self) -> "Drive":
        """Keep samples whose model power is above three sd of the residual: no selection on the noise."""
        fitted = self.positive().target()
        return self._where(power(self.v, self.a, fitted.centre) > 3 * np.sqrt(fitted.variance))

    def target(self) -> ClippedGaussianTarget:
        """The paper's likelihood of these samples, in the paper's box."""
        return ClippedGaussianTarget(design(self.v, self.a), self.P, LOWER, UPPER)

    def _where(self, mask: Mask) -> "Drive":
        return Drive(self.v[mask], self.a[mask], self.P[mask])


@dataclass(frozen=True)
class Estimate:
    """Kept ``chains`` (chains, draws, 3) of [A, C, m] in SI, sd ``sigma`` [W] of the residual, and largest R-hat."""

    chains: Floats
    sigma: float
    r_hat: float

    @property
    def draws(self) -> Floats:
        """Draws (n, 3) of all chains."""
        draws: Floats = self.chains.reshape(-1, 3)
        return draws

    @property
    def mean(self) -> Floats:
        """Posterior means (3,)."""
        mean: Floats = self.draws.mean(axis=0)
        return mean

    @property
    def sd(self) -> Floats:
        """Posterior standard deviations (3,)."""
        sd: Floats = self.draws.std(axis=0, ddof=1)
        return sd

    @property
    def chain_deviation(self) -> Floats:
        """Mean absolute deviation (3,) of the chains' means from their common mean, relative to it."""
        means = self.chains.mean(axis=1)
        deviation: Floats = np.abs(means / means.mean(axis=0) - 1).mean(axis=0)
        return deviation

    def holds(self, theta: Floats) -> Mask:
        """Which of the 90 % intervals (3,) hold ``theta``."""
        low, high = np.quantile(self.draws, [0.05, 0.95], axis=0)
        held: Mask = (low <= theta) & (theta <= high)
        return held


def estimate(kept: Drive, seed: tuple[int, ...] = (0,), kernel: str = "random_walk") -> Estimate:
    """Estimate with sigma fixed at the least-squares point and chains started around it.

    ``kernel`` is the paper's ``random_walk``, or ``independence``, which samples the same posterior faster.
    """
    target = kept.target()
    result = run(target, kernel, CHAINS, BURN_IN, ITERATIONS - BURN_IN, np.random.default_rng(seed))
    r_hat = max(diagnosis.r_hat for diagnosis in result.diagnoses)
    return Estimate(result.draws, float(np.sqrt(target.variance)), r_hat)


@dataclass(frozen=True)
class _Reweighted:
    """The target ``base`` with a sigma^2 ``variance`` (k,) [W^2] of its own for each of k chains."""

    base: ClippedGaussianTarget
    variance: Floats

    @property
    def lower(self) -> Floats:
        """See `Target.lower`."""
        return self.base.lower

    @property
    def upper(self) -> Floats:
        """See `Target.upper`."""
        return self.base.upper

    @property
    def centre(self) -> Floats:
        """See `Target.centre`."""
        return self.base.centre

    def log_density(self, theta: Floats) -> Floats:
        return self.base.log_density(theta) * (self.base.variance / self.variance)

    def curvature(self, theta: Floats) -> Floats:
        return self.base.curvature(theta) * (self.variance / self.base.variance)[:, None, None]


def scheduled_walk(kept: Drive, first_refresh: int, seed: tuple[int, ...] = (0,)) -> Floats:
    """All iterations (chains, ITERATIONS, 3) of the paper's own schedule, from random starts inside the box.

    sigma^2 = chi2 / (n - p) and the steps' covariance are those of each chain's starting point until iteration
    ``first_refresh``, and those of where it is every REFRESH iterations from then on.
    """
    rng = np.random.default_rng(seed)
    base = kept.target()
    edges = [0, *range(first_refresh, ITERATIONS, REFRESH), ITERATIONS]
    parts: list[Floats] = [rng.uniform(LOWER, UPPER, (CHAINS, 1, 3))]
    for begin, end in pairwise(edges):
        position = parts[-1][:, -1]
        residual = np.stack([kept.P - power(kept.v, kept.a, theta) for theta in position])
        variance = np.maximum((residual**2).sum(axis=1) / (len(kept.P) - 3), POWER_RESOLUTION**2)
        parts.append(random_walk(_Reweighted(base, variance), position, 0, end - begin, rng).draws)
    return np.concatenate(parts[1:], axis=1)


@dataclass(frozen=True)
class Availability:
    """The cells of speed x acceleration that a vehicle can reach: power above zero and within given limits."""

    cells: Mask

    @classmethod
    def of(cls, cycle: Cycle, theta: Floats) -> "Availability":
        """Within the speed, acceleration and power that ``cycle`` demands of ``theta``."""
        speed, acceleration = GRID.centres()
        load = design(speed, acceleration) @ theta
        reach = (load > 0) & (load <= power(cycle.v, cycle.a, theta).max())
        return cls(reach & (speed <= cycle.v.max()) & (acceleration <= cycle.a.max()))

    def occupied(self, kept: Drive | Cycle) -> Mask:
        """Available cells (n,) with at least one sample."""
        return self.cells & (np.bincount(GRID.cell(kept.v, kept.a), minlength=GRID.size) > 0)

    def coverage(self, kept: Drive | Cycle) -> float:
        """Occupied / available."""
        return float(self.occupied(kept).sum() / self.cells.sum())

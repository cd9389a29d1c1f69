"""One run of a kernel: starting points, draws, diagnosis; a random walk if independence proposals fail."""

from dataclasses import dataclass

import numpy as np

from estimator.sampling.convergence import Diagnosis, diagnose
from estimator.sampling.likelihood import Target, factor
from estimator.sampling.metropolis import KERNELS, Chains
from estimator.signals import Floats

SPREAD = 3.0  # sd of the chains' starting points around the centre
MIN_ACCEPTANCE = 0.2  # of independence proposals that resemble the target
MAX_R_HAT = 1.05  # of every parameter (Vehtari et al. 2021)
LONGER = 8  # times the draws, where R-hat is above that by the chance of short chains: a box that cuts the density
MIN_ESS_PER_DRAW = 0.05  # effective draws over draws, of the worst parameter
MAX_IMPORTANCE_WEIGHT = 20.0  # of an independence proposal, over the mean weight
WALK_BURN_IN = 1000  # iterations of the random walk that replaces them
WALK_DRAWS = 5000  # of the random walk: the paper's number


@dataclass(frozen=True)
class Run:
    """Draws (chains, draws, p), the name of their kernel, and the diagnosis of each parameter."""

    draws: Floats
    kernel: str
    acceptance: float
    diagnoses: tuple[Diagnosis, ...]

    @property
    def correlation(self) -> Floats:
        """Correlation matrix (p, p) of the draws of all chains."""
        flat = self.draws.reshape(-1, self.draws.shape[2])
        return np.atleast_2d(np.corrcoef(flat.T))


def overdispersed(target: Target, chains: int, rng: np.random.Generator) -> Floats:
    """Random starting points (chains, p) inside the box, with SPREAD times the sd of the density."""
    centre = target.centre
    away = SPREAD * rng.standard_normal((chains, len(centre))) @ factor(target.curvature(centre[None])[0]).T
    return np.clip(centre + away, target.lower, target.upper)


def run(target: Target, kernel: str, chains: int, burn_in: int, draws: int, rng: np.random.Generator) -> Run:
    """Draw from ``target`` with one of `metropolis.KERNELS`, ``chains`` x ``draws`` after ``burn_in`` iterations.

    Independence proposals need a density close to their Gaussian. If a box cuts it, chains mix slowly and are made
    LONGER. If it has several modes or another shape, few proposals are accepted, the effective draws are few, or a few
    draws have all the weight. The random walk, which needs no such similarity, is then run with more iterations. The
    diagnoses show whether it converged: chains that stay in different modes give a large R-hat.
    """
    starts = overdispersed(target, chains, rng)
    if kernel == "independence":
        for length in (draws, LONGER * draws):
            made = KERNELS[kernel](target, starts, burn_in, length, rng)
            judged = _judged(kernel, made)
            if made.heaviest > MAX_IMPORTANCE_WEIGHT or not _is_like_target(judged):
                break
            if max(diagnosis.r_hat for diagnosis in judged.diagnoses) < MAX_R_HAT:
                return judged
    burn_in, draws = max(burn_in, WALK_BURN_IN), max(draws, WALK_DRAWS)
    return _judged("random_walk", KERNELS["random_walk"](target, starts, burn_in, draws, rng))


def _judged(kernel: str, chains: Chains) -> Run:
    diagnoses = tuple(diagnose(chains.draws[:, :, i]) for i in range(chains.draws.shape[2]))
    return Run(chains.draws, kernel, chains.acceptance, diagnoses)


def _is_like_target(run: Run) -> bool:
    """True if the proposals of an independence run were close to its target, by acceptance and effective draws."""
    draws = run.draws.shape[0] * run.draws.shape[1]
    worst = float(np.min([diagnosis.ess_bulk for diagnosis in run.diagnoses]))
    return run.acceptance >= MIN_ACCEPTANCE and worst >= MIN_ESS_PER_DRAW * draws

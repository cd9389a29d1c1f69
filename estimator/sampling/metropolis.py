"""Two Metropolis-Hastings kernels over a batch of chains: independence proposals, and the paper's random walk.

Both are pure functions of a target, starting points and a generator. Metropolis et al. 1953, Hastings 1970.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from estimator.sampling.likelihood import Target
from estimator.signals import Floats

REFRESH = 100  # iterations between new proposal covariances of the random walk
PROPOSAL_DOF = 12.0  # of the independence proposal: tails heavier than any target here
PROPOSAL_WIDTH = 1.1  # sd of the independence proposal over that of the local Gaussian


@dataclass(frozen=True, slots=True)
class Chains:
    """``draws`` (chains, draws, p), those of the burn-in left out, and the share of proposals accepted."""

    draws: Floats
    acceptance: float


Kernel = Callable[[Target, Floats, int, int, np.random.Generator], Chains]


def _factor(covariance: Floats) -> Floats:
    """Lower Cholesky factor (p, p), with a whisper added where a direction has no variance."""
    scale = np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    correlation = covariance / np.outer(scale, scale)
    return scale[:, None] * np.linalg.cholesky(correlation + 1e-12 * np.eye(len(scale)))


def random_walk(target: Target, starts: Floats, burn_in: int, draws: int, rng: np.random.Generator) -> Chains:
    """Random walk whose steps have the covariance sigma^2 (J' J)^-1 of where each chain is now.

    ``starts`` (k, p), one row a chain. The covariance is renewed every REFRESH iterations during burn-in and kept
    from then on, so that the kept draws come from one fixed kernel.
    """
    k, p = starts.shape
    position, density = starts.copy(), target.log_density(starts)
    kept = np.empty((k, draws, p))
    accepted = 0
    factors = np.empty((k, p, p))
    for i in range(burn_in + draws):
        if i % REFRESH == 0 and i <= burn_in:
            factors = np.stack([_factor(target.curvature(theta)) for theta in position])
        proposal = position + np.einsum("kij,kj->ki", factors, rng.standard_normal((k, p)))
        proposed = target.log_density(proposal)
        accept = np.log(rng.random(k)) < proposed - density
        position = np.where(accept[:, None], proposal, position)
        density = np.where(accept, proposed, density)
        if i >= burn_in:
            kept[:, i - burn_in] = position
            accepted += int(accept.sum())
    return Chains(kept, accepted / (k * draws))


def independence(target: Target, starts: Floats, burn_in: int, draws: int, rng: np.random.Generator) -> Chains:
    """Proposals from one heavy-tailed t distribution around the target's centre; ``starts`` (k, p), one row a chain.

    Proposals do not depend on the chain's state, so all of them are drawn and evaluated in one batch; what is left
    of the iteration is a comparison of numbers.
    """
    k, p = starts.shape
    n = burn_in + draws
    factor = PROPOSAL_WIDTH * _factor(target.curvature(target.centre))
    z = rng.standard_normal((n, k, p)) / np.sqrt(rng.chisquare(PROPOSAL_DOF, (n, k, 1)) / PROPOSAL_DOF)
    states = np.concatenate([starts[None], target.centre + z @ factor.T])
    z = np.concatenate([np.linalg.solve(factor, (starts - target.centre).T).T[None], z])
    # An independence chain compares log(target / proposal), the importance weights of the states.
    density = target.log_density(states.reshape(-1, p)).reshape(n + 1, k)
    weight = density + 0.5 * (PROPOSAL_DOF + p) * np.log1p((z**2).sum(axis=2) / PROPOSAL_DOF)
    threshold = np.log(rng.random((n, k)))
    held, index = weight[0], np.zeros((n + 1, k), dtype=np.int64)
    for i in range(1, n + 1):
        accept = weight[i] > held + threshold[i - 1]
        held = np.where(accept, weight[i], held)
        index[i] = np.where(accept, i, index[i - 1])
    kept = np.take_along_axis(states, index[burn_in + 1 :, :, None], axis=0)
    moved = np.diff(index[burn_in:], axis=0) != 0
    return Chains(np.ascontiguousarray(kept.swapaxes(0, 1)), float(moved.mean()))


KERNELS: dict[str, Kernel] = {"independence": independence, "random_walk": random_walk}

"""Two Metropolis-Hastings kernels over a batch of chains: independence proposals, and the paper's random walk.

Both are pure functions of a target, starting points and a generator. Metropolis et al. 1953, Hastings 1970.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from estimator.sampling.likelihood import Target, factor
from estimator.signals import Floats

REFRESH = 100  # iterations between new proposal covariances of the random walk
ACCEPTANCE = 0.3  # that the steps of the random walk are scaled to
SCALING = 2.0  # log of the scale, per excess of acceptance over ACCEPTANCE, at every refresh
PROPOSAL_DOF = 12.0  # of the independence proposal: tails as heavy as those of any target here


@dataclass(frozen=True, slots=True)
class Chains:
    """``draws`` (chains, draws, p), those of the burn-in left out, and the share of proposals accepted."""

    draws: Floats
    acceptance: float


Kernel = Callable[[Target, Floats, int, int, np.random.Generator], Chains]


def random_walk(target: Target, starts: Floats, burn_in: int, draws: int, rng: np.random.Generator) -> Chains:
    """Random walk whose steps have the covariance sigma^2 (J' J)^-1 of where each chain is now.

    ``starts`` (k, p), one row a chain. The covariance is renewed every REFRESH iterations during burn-in, and scaled
    where too few or too many steps are accepted: a box may cut the density far narrower than its curvature says.
    From then on both are kept, so that the kept draws of a chain come from one fixed kernel.
    """
    k, p = starts.shape
    position, density = starts.copy(), target.log_density(starts)
    kept = np.empty((k, draws, p))
    total, recent = 0, np.zeros(k)
    scale, factors = np.ones(k), factor(target.curvature(starts))
    for i in range(burn_in + draws):
        if 0 < i <= burn_in and i % REFRESH == 0:
            scale *= np.exp(SCALING * (recent / REFRESH - ACCEPTANCE))
            factors = scale[:, None, None] * factor(target.curvature(position))
            recent[:] = 0
        proposal = position + np.einsum("kij,kj->ki", factors, rng.standard_normal((k, p)))
        proposed = target.log_density(proposal)
        accept = proposed - density > -rng.standard_exponential(k)
        np.copyto(position, proposal, where=accept[:, None])
        np.copyto(density, proposed, where=accept)
        recent += accept
        if i >= burn_in:
            kept[:, i - burn_in] = position
            total += int(np.count_nonzero(accept))
    return Chains(kept, total / (k * draws))


def independence(target: Target, starts: Floats, burn_in: int, draws: int, rng: np.random.Generator) -> Chains:
    """Proposals from one heavy-tailed t distribution around the target's centre; ``starts`` (k, p), one row a chain.

    Proposals do not depend on the chain's state, so all of them are drawn and evaluated in one batch; what is left
    of the iteration is a comparison of numbers.
    """
    k, p = starts.shape
    n = burn_in + draws
    width = factor(target.curvature(target.centre[None])[0])
    # Columns are proposals: chain by chain within an iteration, the starting points first.
    z = np.empty((p, (n + 1) * k))
    z[:, :k] = np.linalg.solve(width, (starts - target.centre).T)
    z[:, k:] = rng.standard_normal((p, n * k))
    z[:, k:] *= np.sqrt(PROPOSAL_DOF / 2 / rng.standard_gamma(PROPOSAL_DOF / 2, n * k))
    states = (width @ z).T + target.centre
    states[:k] = starts
    # An independence chain compares log(target / proposal), the importance weights of the states.
    weight = target.log_density(states)
    weight += 0.5 * (PROPOSAL_DOF + p) * np.log1p(np.einsum("ij,ij->j", z, z) / PROPOSAL_DOF)
    weight = weight.reshape(n + 1, k)
    hurdle = weight[1:] + rng.standard_exponential((n, k))
    # Whoever does not clear the hurdle stays: takes over weight and place of the iteration before.
    place, stay = np.arange(len(states)).reshape(n + 1, k), np.empty((n, k), dtype=bool)
    for i, stays in enumerate(stay):
        np.less_equal(hurdle[i], weight[i], out=stays)
        np.copyto(weight[i + 1], weight[i], where=stays)
        np.copyto(place[i + 1], place[i], where=stays)
    return Chains(states.take(place[burn_in + 1 :].T, axis=0), 1.0 - float(stay[burn_in:].mean()))


KERNELS: dict[str, Kernel] = {"independence": independence, "random_walk": random_walk}

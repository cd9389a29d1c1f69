"""Two Metropolis-Hastings kernels over a batch of chains: independence proposals, and the paper's random walk.

Both are pure functions of a target, starting points and a generator. Metropolis et al. 1953, Hastings 1970.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import exp, lgamma

import numpy as np

from estimator.sampling.likelihood import Target, factor
from estimator.signals import Floats

REFRESH = 100  # iterations between new proposal covariances of the random walk
ACCEPTANCE = 0.3  # that the steps of the random walk are scaled to
SCALING = 2.0  # log of the scale, per excess of acceptance over ACCEPTANCE, at every refresh
WIDE_SHARE = 0.2  # of the independence proposals that come from a t distribution, the others from a Gaussian
WIDE_DOF = 6.0  # of that t: tails heavier than those of any target here


@dataclass(frozen=True, slots=True)
class Chains:
    """Result of a kernel: ``draws`` (chains, draws, p) without the burn-in, and the statistics of its proposals."""

    draws: Floats
    acceptance: float  # share of the proposals
    heaviest: float = 1.0  # importance weight of a proposal, over their mean; 1 where proposals have none


Kernel = Callable[[Target, Floats, int, int, np.random.Generator], Chains]


def random_walk(target: Target, starts: Floats, burn_in: int, draws: int, rng: np.random.Generator) -> Chains:
    """Draw by a random walk whose steps have the covariance sigma^2 (J' J)^-1 at the position of each chain.

    ``starts`` (k, p) has one row a chain. The covariance is updated every REFRESH iterations during burn-in, and scaled
    towards the acceptance rate ACCEPTANCE: a box may cut the density far narrower than its curvature says. After
    burn-in both are fixed, so that the draws of a chain come from one kernel.
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
    """Draw by proposals from one heavy-tailed distribution around the target's centre.

    ``starts`` (k, p) has one row a chain. Proposals do not depend on the state of a chain, so all are drawn and
    evaluated in one batch; the iterations only process the few that are rejected. The chains converge by the factor
    1 - 1 / M an iteration, with M the largest importance weight over the mean weight (Mengersen & Tweedie 1996). A
    single proposal in a distant mode makes M large.
    """
    k, p = starts.shape
    n = burn_in + draws + 1  # states of a chain, which stand in a row, its start first
    width = factor(target.curvature(target.centre[None])[0])
    z = rng.standard_normal((p, k * n))
    scale, wide = np.ones(k * n), np.flatnonzero(rng.random(k * n) < WIDE_SHARE)
    scale[wide] = np.sqrt(WIDE_DOF / 2 / rng.standard_gamma(WIDE_DOF / 2, len(wide)))
    z *= scale
    z[:, ::n] = np.linalg.solve(width, (starts - target.centre).T)
    columns = width @ z
    columns += target.centre[:, None]
    states = columns.T
    states[::n] = starts
    # An independence chain compares log(target / proposal), the importance weights of the states.
    weight = target.log_density(states)
    weight -= _log_proposal(z)
    hurdle = rng.standard_exponential(k * n + 1)
    hurdle[:-1] += weight
    hurdle[::n] = np.inf
    heaviest = 1 / float(np.exp(weight - weight.max()).mean())
    # A rejected proposal keeps the previous state. The vectorised code below equals, for each chain,
    #     state = 0
    #     for i in range(1, n):
    #         if hurdle[i] > weight[state]:
    #             state = i
    #         states[i] = states[state]
    # It compares each proposal with the one before, then those behind a rejected one with the state that was kept. The
    # kept state has the larger weight, so a rejection stays one.
    refused = np.zeros(k * n, dtype=bool)
    rejected = np.flatnonzero(hurdle[1:-1] <= weight[:-1]) + 1
    stay = rejected - 1
    while len(rejected):
        refused[rejected] = True
        states[rejected] = states[stay]
        again = hurdle[rejected + 1] <= weight[stay]
        rejected, stay = rejected[again] + 1, stay[again]
    kept = slice(burn_in + 1, None)
    acceptance = 1.0 - float(refused.reshape(k, n)[:, kept].mean())
    return Chains(states.reshape(k, n, p)[:, kept], acceptance, heaviest)


def _log_proposal(z: Floats) -> Floats:
    """Log density (k,) at columns ``z`` (p, k) of the defensive mixture (Hesterberg 1995), up to a constant."""
    p, squared = len(z), np.einsum("ij,ij->j", z, z)
    constant = exp(lgamma((WIDE_DOF + p) / 2) - lgamma(WIDE_DOF / 2)) * (2 / WIDE_DOF) ** (p / 2)
    t = np.exp(-0.5 * (WIDE_DOF + p) * np.log1p(squared / WIDE_DOF))
    density: Floats = np.log((1 - WIDE_SHARE) * np.exp(-0.5 * squared) + WIDE_SHARE * constant * t)
    return density


KERNELS: dict[str, Kernel] = {"independence": independence, "random_walk": random_walk}

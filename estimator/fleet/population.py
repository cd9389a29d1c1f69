"""Population of the vehicles of a fleet: mean, spread and outliers.

A parameter of vehicle ``v`` is z_v with sd s_v. Most vehicles are drawn from N(mu, tau^2), a few from a second, wide
component (Tukey's contaminated normal). Outliers so change mu and tau little. Both are summed over a grid. Each vehicle
is compared with the prediction from the others. The false-discovery rate over all comparisons is that of Benjamini and
Hochberg (1995).
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from estimator.fleet.pooling import Mixture
from estimator.signals import Floats

SCALE = 0.05  # sd of the half-normal prior of tau, as a share of the median
OUTLIERS = 0.1  # prior share of outliers
OUTLIER_SCALE = 0.5  # sd of outliers, as a share of the median
SPREADS = 24  # nodes of the grid of tau
COARSE, FINE = 81, 121  # nodes of the grids of mu: where vehicles may be at all, and where most are
FINE_REACH = 6.0  # of the fine one, in sds of a usual vehicle about the median
MAX_SPREAD_SDS = 5.0  # largest node of tau, in sd of its prior
MIN_VEHICLES = 4  # vehicles: each is compared with at least three others


@dataclass(frozen=True)
class Population:
    """Parameter in a fleet: distribution of the value of a ``new`` vehicle, and p-values (n,) of the vehicles."""

    new: Mixture
    p_values: Floats


def population(z: Floats, sd: Floats) -> Population:
    """Compare vehicles by estimates ``z`` (n,) with their ``sd`` (n,)."""
    middle = float(np.median(z))
    size = abs(middle)
    tau_nodes = SCALE * size * MAX_SPREAD_SDS * np.linspace(0.0, 1.0, SPREADS) ** 2
    reach = 3 * float(np.max(sd)) + SCALE * size
    usual = FINE_REACH * (1.5 * float(np.median(np.abs(z - middle))) + float(np.median(sd)))
    fine = np.linspace(middle - usual, middle + usual, FINE)
    mu_nodes = np.unique(np.concatenate([np.linspace(z.min() - reach, z.max() + reach, COARSE), fine]))
    mu, tau = (grid.ravel() for grid in np.meshgrid(mu_nodes, tau_nodes, indexing="ij"))
    prior = np.exp(-0.5 * (tau / (SCALE * size)) ** 2) * np.outer(np.gradient(mu_nodes), np.gradient(tau_nodes)).ravel()
    width = np.sqrt(tau[:, None] ** 2 + sd**2)  # (K, n)
    wide = np.sqrt(width**2 + (OUTLIER_SCALE * size) ** 2)
    left = z - mu[:, None]
    log_shown = np.logaddexp(
        np.log(1 - OUTLIERS) - 0.5 * (left / width) ** 2 - np.log(width),
        np.log(OUTLIERS) - 0.5 * (left / wide) ** 2 - np.log(wide),
    )
    together = log_shown.sum(axis=1)
    p_values = np.empty(len(z))
    for v in range(len(z)):  # the posterior from the others
        weights = _normalised(together - log_shown[:, v], prior)
        below = float(weights @ ndtr(left[:, v] / width[:, v]))
        p_values[v] = 2 * min(below, 1 - below)
    weights = _normalised(together, prior)
    used = weights > 0
    smallest = 1e-9 * size
    return Population(Mixture(weights[used], mu[used], np.maximum(tau[used], smallest)), p_values)


def _normalised(log_weight: Floats, prior: Floats) -> Floats:
    weights = np.exp(log_weight - log_weight.max()) * prior
    normalised: Floats = weights / weights.sum()
    return normalised

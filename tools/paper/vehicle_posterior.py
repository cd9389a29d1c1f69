"""The hierarchical model on the printed runs: posterior of the vehicle's parameters in the paper's units."""

from dataclasses import replace

import numpy as np

from estimator.model.road_load import design, power
from estimator.signals import Floats
from paper.cycles import Cycle
from paper.experiments import truth_of, white_noise_covariance
from paper.hierarchy import CycleRuns, HierarchicalFit, Prior, fit
from paper.printed import DIGITS, PRINTED
from paper.vehicles import HP, NOMINAL, TO_SI

UNIT = NOMINAL / TO_SI  # of A, C, m in the model: all are near 1
OFFSET_PRIOR = 1.0  # hp, scale of tau
BETWEEN_PRIORS = (0.05, 0.025, 0.1)  # scales of beta, shares of the nominal value; the first is the one reported
SEED = 20
CRUISE = 55.0  # mph, of the total resistance A + C v^2


def offset_response(cycle: Cycle) -> Floats:
    """Change (3,) of the least-squares estimates, in the paper's units, for 1 hp too much power in every sample."""
    truth = truth_of(cycle.name)
    active = design(cycle.v, cycle.a)[power(cycle.v, cycle.a, truth) > 0]
    response: Floats = np.linalg.lstsq(active, np.full(len(active), HP))[0] / TO_SI
    return response


def printed_runs(cycles: dict[str, Cycle]) -> list[CycleRuns]:
    """Printed estimates of every cycle with their covariances, in units of UNIT."""
    return [
        CycleRuns(
            y=PRINTED[name].estimates / UNIT,
            noise=white_noise_covariance(name) / np.outer(UNIT, UNIT),
            offset=offset_response(cycle) / UNIT,
            rounding=np.diag((DIGITS / UNIT) ** 2 / 12),
        )
        for name, cycle in cycles.items()
    ]


def vehicle_posterior(cycles: dict[str, Cycle], scale: float) -> HierarchicalFit:
    """Posterior in the paper's units for a prior of beta with ``scale``, a share of the nominal values; tau in hp."""
    prior = Prior(tau=OFFSET_PRIOR, beta=np.full(3, scale))
    found = fit(printed_runs(cycles), prior, np.random.default_rng(SEED))
    return replace(found, beta=found.beta * UNIT, mu=found.mu * UNIT, theta=found.theta * UNIT)


def vehicle_posteriors(cycles: dict[str, Cycle]) -> dict[float, HierarchicalFit]:
    """Posterior for each of BETWEEN_PRIORS."""
    return {scale: vehicle_posterior(cycles, scale) for scale in BETWEEN_PRIORS}

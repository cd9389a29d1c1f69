"""Test for a change of the force per acceleration under one load: a drifting torque, or an unnoticed change of load.

The model has a constant 1/m. A change of shape g(t), from -1/2 to 1/2 over the driving with the load (a ramp, and
steps between its PARTS), gives

    a = F / m (1 + r g(t)) - (A / m) (1 + r_A g(t)) - (C / m) (1 + r_C g(t)) rho v^2 ...

A and C may change too, with tyres, oil and wind: so r is determined by acceleration, as the mass is, and not by the
level of the force. Change k is a shape with a prior of its size, w_k its posterior probability, and beta_k are the
coefficients fitted with it (law of total variance, over the changes and none):

    mean = sum w_k beta_k,   covariance = sum w_k (covariance_k + (beta_k - mean) (beta_k - mean)')

No drive determines at which end of a change the force was right: this adds the relative variance w_k E[r_k^2] / 4 to
that of 1/m.
"""

from dataclasses import dataclass, replace

import numpy as np

from estimator.estimation.mixture import between
from estimator.estimation.road_fit import MIN_INVERSE_MASS, RoadFit
from estimator.estimation.road_likelihood import PARTS, ROAD_LOAD
from estimator.estimation.savage_dickey import log_bayes_factor
from estimator.signals import Floats
from estimator.strides import DURATION

# Prior sd of a change, as a share of 1/m, and rate per second of driving. First: changes of loads and sensors. Second:
# warm-up of efficiencies; on 28 trips of a BMW i3 it gains 11 in log evidence with the road hidden and 9 with it shown,
# nearly the maximum over sds from 0.01 to 0.04.
CHANGES = ((0.1, 0.6 / 3600), (0.02, 6 / 3600))
MAX_EXPECTED = 0.6  # prior probability of a change, however long the drive
BESIDE_SDS = (0.3, 0.3)  # prior sd of the simultaneous changes of A/m and C/m, as a share of these (warm-up, wind)
# Vague prior sd of a change in the normal equations, as a share of 1/m; replaced by the one in CHANGES after their
# correction for noise, because the correction applies to the data and not to the prior.
VAGUE_SD = 3.0
MIN_PROBABILITY = 0.99  # of a change, from which parts of a drive contradict each other
MIN_SHARE = 0.04  # smallest size of a contradiction, as a share of 1/m: a smaller change only widens the estimate
EACH_LOAD = (  # remedy for a `GainChanges.contradiction`: a longer log has both loads
    "give the logs of each load alone, if the load changed on the way; else `roadload diagnose` with the same logs "
    "names a missing effect"
)


@dataclass(frozen=True, kw_only=True)
class GainChanges:
    """Possible changes with their posterior ``probability`` (k,), and the difference that each makes to a fit.

    ``shift`` (k, p) of the coefficients and additional ``covariance`` (k, p, p), both relative to the fit without a
    change; ``size`` (k,) of the change as a share of 1/m, and its ``sd`` (k,).
    """

    probability: Floats
    shift: Floats
    covariance: Floats
    size: Floats
    sd: Floats

    def averaged(self, found: RoadFit) -> RoadFit:
        """Return the fit averaged over all changes and none, see the module."""
        w = self.probability
        shift, spread = between(w, self.shift)
        covariance = found.covariance + spread + np.einsum("k,kij->ij", w, self.covariance)
        covariance[0, 0] += found.beta[0] ** 2 * float(w @ (self.size**2 + self.sd**2)) / 4
        return replace(found, beta=found.beta + shift, covariance=covariance)

    def contradiction(self, found: RoadFit) -> str:
        """Message that parts of the drive contradict each other; empty if a change is improbable or small."""
        k = int(np.argmax(self.probability))
        probability = self.probability.sum()
        if probability < MIN_PROBABILITY or self.probability @ np.abs(self.size) < MIN_SHARE * probability:
            return ""
        middle, change = found.beta[0] + self.shift[k, 0], found.beta[0] * self.size[k]
        before, after = middle - change / 2, middle + change / 2
        how = f"mass {_mass(before)} and {_mass(after)} kg"
        if min(before, after) <= MIN_INVERSE_MASS:
            how = "in one of them speed does not change with force"
        return f"two parts of the drive contradict each other: {how}"


def _mass(inverse: float) -> str:
    """Mass [kg] of an ``inverse`` [1/kg], to four digits and never as a power of ten."""
    return f"{float(f'{1 / inverse:.4g}'):,.0f}"


def gain_changes(found: RoadFit) -> GainChanges:
    """Return the posterior of the changes of force under the present load, at the scales of a fit."""
    equations, m = found.equations, found.road_load[2]
    p, unit = len(equations.prior), equations.unit
    whole = unit[:ROAD_LOAD] * [found.beta[0], *(found.road_load[:2] / m)]
    without, spread, _ = equations.solve()
    expected = np.array([rate for _, rate in CHANGES]) * DURATION * max(equations.present, 1)
    prior = expected * min(1.0, MAX_EXPECTED / expected.sum())
    log_odds, shifts, spreads, sizes = [np.log(1 - prior.sum())], [], [], []
    for k in range(PARTS):
        beta, covariance, _ = equations.solve(k, (whole * [VAGUE_SD, *BESIDE_SDS]) ** -2.0)
        vague, with_it = covariance[p, p], covariance[:p, p]
        for (sd, _), chance in zip(CHANGES, prior, strict=True):
            believed = (whole[0] * sd) ** -2.0
            variance = 1 / (1 / vague + believed - (whole[0] * VAGUE_SD) ** -2.0)
            size = beta[p] * variance / vague
            log_odds.append(np.log(chance / PARTS) + log_bayes_factor(size, np.sqrt(variance), believed**-0.5))
            shifts.append((beta[:p] + with_it * (size - beta[p]) / vague - without) / unit)
            wider = covariance[:p, :p] - np.outer(with_it, with_it) * (1 - variance / vague) / vague - spread
            spreads.append(wider / np.outer(unit, unit))
            sizes.append(np.array([size, np.sqrt(variance)]) / whole[0])
    relative_size, relative_sd = np.array(sizes).T
    return GainChanges(
        probability=np.exp(np.array(log_odds[1:]) - np.logaddexp.reduce(log_odds)),
        shift=np.array(shifts),
        covariance=np.array(spreads),
        size=relative_size,
        sd=relative_sd,
    )

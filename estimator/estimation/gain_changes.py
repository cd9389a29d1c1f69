"""Whether the force per acceleration changed under a load: a torque that drifts, a load that changed unnoticed.

The model says that 1/m is one number. Each of some shapes g(t) of a change, from -1/2 to 1/2 while the load is driven
(a ramp, and steps between its PARTS), would add

    a = F / m (1 + r g(t)) - (A / m) (1 + r_A g(t)) - (C / m) (1 + r_C g(t)) rho v^2 ...

A and C may change too, as tyres, oil and wind do: so r follows from acceleration, as the mass does, and not from the
level of the force. With w_k the posterior probability of shape k, and beta_k the coefficients beside it (law of total
variance, over the shapes and no change),

    mean = sum w_k beta_k,   covariance = sum w_k (covariance_k + (beta_k - mean) (beta_k - mean)')

No drive tells at which end of a change the force was right, so 1/m has the relative variance w_k E[r_k^2] / 4 more.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.road_fit import RoadFit
from estimator.estimation.road_likelihood import ROAD_LOAD, Likelihood
from estimator.model.road import RoadModel
from estimator.signals import Floats, Mask
from estimator.strides import DURATION, Strides

PARTS = 4  # of the driving with a load, between which a step may be
CHANGES = 0.6 / 3600  # 1/s of driving: prior rate of changes, by any of the shapes
CHANGE_SDS = np.array([0.1, 0.3, 0.3])  # prior sd of a change, as a share of 1/m, A/m and C/m (warm-up, wind)
MAX_EXPECTED = 0.5  # prior probability of a change, however long the drive
MIN_PROBABILITY = 0.99  # of a change, from which on parts of a drive contradict each other
MIN_SHARE = 0.04  # and its size, as a share of 1/m: a smaller one widens the estimate and does not withhold it


@dataclass(frozen=True, kw_only=True)
class GainChanges:
    """Shapes of a change with their posterior probability, and what each of them does to a fit.

    ``probability`` (k,); ``shift`` (k, p) of the coefficients; ``covariance`` (k, p, p) beyond that without a change;
    ``size`` (k,) of the change as a share of 1/m, and its ``sd`` (k,).
    """

    probability: Floats
    shift: Floats
    covariance: Floats
    size: Floats
    sd: Floats

    def averaged(self, found: RoadFit) -> RoadFit:
        """The fit averaged over whether the force changed, and how."""
        w, mean = self.probability, self.probability @ self.shift
        apart = self.shift - mean
        between = (apart.T * w) @ apart + (1 - w.sum()) * np.outer(mean, mean)
        covariance = found.covariance + between + np.einsum("k,kij->ij", w, self.covariance)
        covariance[0, 0] += found.beta[0] ** 2 * float(w @ (self.size**2 + self.sd**2)) / 4
        return replace(found, beta=found.beta + mean, covariance=covariance)

    def contradiction(self, found: RoadFit) -> str:
        """Reason why parts of the drive contradict each other; empty where noise explains it."""
        k = int(np.argmax(self.probability))
        if self.probability.sum() < MIN_PROBABILITY or abs(self.size[k]) < MIN_SHARE:
            return ""
        middle, change = found.beta[0] + self.shift[k, 0], found.beta[0] * self.size[k]
        before, after = 1 / (middle - change / 2), 1 / (middle + change / 2)
        return f"two parts of the drive contradict each other: mass {before:.4g} and {after:.4g} kg"


def gain_changes(strides: Strides, found: RoadFit) -> GainChanges:
    """The changes of force under the present load that the ``strides`` of a fit show, at its scales."""
    model = RoadModel(strides, found.scales.alpha, found.scales.wander)
    likelihood = Likelihood(model, found.terms, found.road_load, found.scales.lag, found.departures, found.taken)
    present = model.driven.t >= max(found.departures, default=-np.inf)
    gram = model.condition(found.scales.values).gram(with_changes(likelihood, shapes_of(present)))
    p, unit, known = len(likelihood.prior), likelihood.unit, np.diag(likelihood.prior)
    road_load = np.append(found.beta[0], found.road_load[:2] / found.road_load[2])
    expected = CHANGE_SDS * road_load * unit[:ROAD_LOAD]
    plain = np.arange(1, 1 + p)
    without, spread = _solved(gram, plain, known)
    prior = min(CHANGES * DURATION * max(int(present.sum()), 1), MAX_EXPECTED)
    log_odds, shifts, spreads, sizes = [np.log(1 - prior)], [], [], []
    for k in range(PARTS):
        changing = 1 + p + ROAD_LOAD * k + np.arange(ROAD_LOAD)
        beta, covariance = _solved(gram, np.append(plain, changing), np.append(known, expected**-2.0))
        size, variance = beta[p], covariance[p, p]
        gain = 0.5 * (size**2 / variance + np.log(variance / expected[0] ** 2))
        log_odds.append(np.log(prior / PARTS) + gain)
        shifts.append((beta[:p] - without) / unit)
        spreads.append((covariance[:p, :p] - spread) / np.outer(unit, unit))
        sizes.append(np.array([size, np.sqrt(variance)]) / (unit[0] * found.beta[0]))
    relative_size, sd = np.array(sizes).T
    return GainChanges(
        probability=np.exp(np.array(log_odds[1:]) - np.logaddexp.reduce(log_odds)),
        shift=np.array(shifts),
        covariance=np.array(spreads),
        size=relative_size,
        sd=sd,
    )


def shapes_of(present: Mask) -> Floats:
    """Shapes (n, PARTS) of a change in the ``present`` strides (n,): a ramp, and a step between any two parts."""
    position = np.cumsum(present) / max(int(present.sum()), 1)
    steps = [np.where(position > k / PARTS, 0.5, -0.5) for k in range(1, PARTS)]
    shapes: Floats = np.column_stack([position - 0.5, *steps]) * present[:, None]
    return shapes


def with_changes(likelihood: Likelihood, shapes: Floats) -> Floats:
    """Data of a likelihood, with the columns of 1/m, A/m and C/m once more for each of the ``shapes`` (n, k)."""
    plain, n = likelihood.data, len(shapes)
    changing = np.zeros((len(plain), ROAD_LOAD * shapes.shape[1]))
    changing[:n] = (shapes[:, :, None] * plain[:n, None, 1 : 1 + ROAD_LOAD]).reshape(n, -1)
    return np.column_stack([plain, changing])


def _solved(gram: Floats, places: NDArray[np.int64], precision: Floats) -> tuple[Floats, Floats]:
    """Coefficients at ``places`` (p,) of a gram matrix and their covariance (p, p), with a prior ``precision`` (p,)."""
    covariance = np.linalg.inv(gram[np.ix_(places, places)] + np.diag(precision))
    return covariance @ gram[places, 0], covariance

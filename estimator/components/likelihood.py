"""One likelihood for all components: the evidence of any set of them beside the road load and the road.

With K the covariance of everything that is not a component (road, noise of torque and speed; see `model.road`) and X
the columns of a set, whitened by K,

    log p(a | set) = -1/2 (log|K| + log|1 + P X'K^-1 X| + a'K^-1 a - b' (X'K^-1 X + P^-1) b) + log prior of the signs

with P the prior covariance of the amplitudes and b their posterior mean. All sets share K, so the products of all
columns are computed once, and each set is a small system of equations. What noise of the measured force adds to the
products is taken off first (a corrected score, see `estimation.road_fit`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import log_ndtr

from estimator.components.component import Component, Frame
from estimator.estimation.road_fit import RoadFit
from estimator.estimation.road_likelihood import DRAG, LAG, PROBES, Likelihood, force_errors, limited
from estimator.model.road import Conditioned, RoadModel
from estimator.signals import Floats
from estimator.strides import Strides


@dataclass(frozen=True)
class Posterior:
    """Amplitudes of a set of components and the base before them: mean (p,) and covariance (p, p), in own units."""

    mean: Floats
    covariance: Floats
    base: int  # how many belong to the base
    log_evidence: float


@dataclass(frozen=True)
class Judged:
    """One-column components added to a set, each alone: gain in log evidence, value and sd, all (c,)."""

    gain: Floats
    value: Floats
    sd: Floats


class JointLikelihood:
    """The likelihood of one drive for sets of ``components``.

    Parameters
    ----------
    strides
        With and without known force, in order of time.
    fit
        Of the road model to them, which gives the scales of road and noise.
    components
        All that may be asked about.
    rng
        Source of the simulated noise of the correction.
    """

    def __init__(
        self,
        strides: Strides,
        fit: RoadFit,
        components: Sequence[Component],
        rng: np.random.Generator,
    ) -> None:
        self.frame, self.components = Frame.of(fit), list(components)
        self.model = model = RoadModel(strides, fit.scales.alpha, fit.scales.wander)
        base = Likelihood(model, (), fit.theta[:3], fit.scales.lag)
        self.conditioned: Conditioned = model.condition(fit.scales.values)
        self.base_size = base.data.shape[1] - 1
        columns = [component.columns(self.frame) for component in components]
        ends = self.base_size + np.cumsum([0, *(column.shape[1] for column in columns)])
        self.places = [np.arange(start, end) for start, end in pairwise(ends)]
        self.data = np.zeros((len(base.data), 1 + int(ends[-1])))
        self.data[:, : 1 + self.base_size] = base.data
        if columns:
            self.data[: len(model.driven), 1 + self.base_size :] = np.hstack(columns)
        self.unit = np.concatenate([base.unit, np.ones(int(ends[-1]) - self.base_size)])
        gram = self.conditioned.gram(self.data)
        self._total, self._moment = float(gram[0, 0]), gram[1:, 0]
        self._prior = np.diag(base.prior).copy()
        sds = [np.full(len(place), c.sd) for place, c in zip(self.places, components, strict=True)]
        believed = gram[1:, 1:] + np.diag(np.concatenate([self._prior, *(sd**-2.0 for sd in sds)]))
        self._information = gram[1:, 1:] - limited(self._noise(base, fit, rng), believed)

    def _noise(self, base: Likelihood, fit: RoadFit, rng: np.random.Generator) -> Floats:
        """Mean contribution (p, p) of noise of the measured force to the products of all columns."""
        noisy = [i for i, component in enumerate(self.components) if component.is_noisy]
        places = np.concatenate([np.array([0, LAG, DRAG]), *(self.places[i] for i in noisy)]).astype(np.int64)
        force, n = self.frame.force, len(self.frame.force)
        total = np.zeros((self.data.shape[1] - 1, self.data.shape[1] - 1))
        for error, rate in force_errors(base.model, fit.scales.values, 1 / float(fit.beta[0]), PROBES, rng):
            drag = np.minimum(force + error, 0.0) - np.minimum(force, 0.0)
            frame = self.frame.disturbed(error)
            changes = [error / self.unit[0], rate / self.unit[LAG], drag / self.unit[DRAG]]
            changes += [self.components[i].columns(frame) - self.data[:n, 1 + self.places[i]] for i in noisy]
            data = np.zeros((len(self.data), len(places)))
            data[:n] = np.column_stack(changes)
            total[np.ix_(places, places)] += self.conditioned.gram(data) / PROBES
        return total

    def observe(self, index: int, weight: float, value: float) -> None:
        """Add a measurement ``weight`` x amplitude = ``value``, both over its sd, of a component with one column."""
        place = self.places[index][0]
        self._information[place, place] += weight**2
        self._moment[place] += weight * value

    def _set(self, chosen: Sequence[int]) -> tuple[Floats, Floats, Floats]:
        """Places of a set, its information with the prior, and the prior's precision."""
        places = np.concatenate([np.arange(self.base_size), *(self.places[i] for i in chosen)])
        sds = [np.full(len(self.places[i]), self.components[i].sd) for i in chosen]
        prior = np.concatenate([self._prior, *(sd**-2.0 for sd in sds)])
        return places, self._information[np.ix_(places, places)] + np.diag(prior), prior

    def posterior(self, chosen: Sequence[int]) -> Posterior:
        """Amplitudes and log evidence of the components with numbers in ``chosen``, up to a constant of the drive."""
        places, information, prior = self._set(chosen)
        unit = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        covariance = np.linalg.inv(information * np.outer(unit, unit)) * np.outer(unit, unit)
        mean = covariance @ self._moment[places]
        volume = float(np.linalg.slogdet(information * np.outer(unit, unit))[1] - 2 * np.log(unit).sum())
        log = -0.5 * (volume - np.log(prior).sum() + self._total - self._moment[places] @ mean)
        at = self.base_size
        for i in chosen:
            if self.components[i].positive:
                log += float(log_ndtr(mean[at] / np.sqrt(covariance[at, at]))) + np.log(2)
            at += len(self.places[i])
        own = self.unit[places]
        return Posterior(mean / own, covariance / np.outer(own, own), self.base_size, float(log))

    def log_evidence(self, chosen: Sequence[int]) -> float:
        """Of the set with numbers in ``chosen``, less the cost of its times."""
        return self.posterior(chosen).log_evidence - sum(self.components[i].cost for i in chosen)

    def gains(self, chosen: Sequence[int], candidates: Sequence[int]) -> Judged:
        """What each of ``candidates`` with one column adds to a set, costs not counted."""
        places, information, _ = self._set(chosen)
        new = np.array([self.places[i][0] for i in candidates], dtype=np.int64)
        cross = self._information[np.ix_(places, new)]
        weights = np.linalg.solve(information, np.column_stack([cross, self._moment[places]]))
        strength = np.diag(self._information)[new] - np.sum(cross * weights[:, :-1], axis=0)
        score = self._moment[new] - cross.T @ weights[:, -1]
        usual = np.array([self.components[i].sd for i in candidates])
        positive = np.array([self.components[i].positive for i in candidates])
        precision = np.maximum(strength, 0.0) + usual**-2.0
        value, sd = score / precision, precision**-0.5
        gain = 0.5 * score**2 / precision - 0.5 * np.log(precision * usual**2)
        return Judged(gain + np.where(positive, log_ndtr(value / sd) + np.log(2), 0.0), value, sd)

    def weighed_residual(self, chosen: Sequence[int]) -> Floats:
        """K^-1 (a - X b) (n,) of the motion beside a set of components: its products with columns are their scores."""
        places, information, _ = self._set(chosen)
        amplitudes = np.linalg.solve(information, self._moment[places])
        residual = self.data[:, 0] - self.data[:, 1 + places] @ amplitudes
        return self.conditioned.weighed(residual)[: len(self.frame.strides)]

    def projected(self, chosen: Sequence[int], columns: Floats) -> tuple[Floats, Floats]:
        """Products (c, c) and scores (c,) of further ``columns`` (n, c), off a set of components."""
        places, information, _ = self._set(chosen)
        wide = np.zeros((len(self.data), 1 + len(places) + columns.shape[1]))
        wide[:, 0] = self.data[:, 0]
        wide[:, 1 : 1 + len(places)] = self.data[:, 1 + places]
        wide[: len(columns), 1 + len(places) :] = columns
        gram = self.conditioned.gram(wide)
        split = 1 + len(places)
        cross = gram[1:split, split:]
        weights = np.linalg.solve(information, np.column_stack([cross, self._moment[places]]))
        products = gram[split:, split:] - cross.T @ weights[:, :-1]
        score: Floats = gram[split:, 0] - cross.T @ weights[:, -1]
        return products, score

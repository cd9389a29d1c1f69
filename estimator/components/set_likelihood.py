"""The evidence of any set of components from the products of all their columns, computed once.

Data y = X b + noise of covariance K, with a Gaussian prior of covariance P for the amplitudes b. With the products of
columns weighted by K^-1,

    log p(y | set) = 1/2 (log|P^-1| - log|X'K^-1 X + P^-1| - y'K^-1 y + b^' (X'K^-1 X + P^-1) b^) + log prior of signs

up to a constant that all sets share, b^ being the posterior mean. The columns of a base are in every set.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import log_ndtr

from estimator.components.one_sided import cut_at_zero, log_evidence_of_sign
from estimator.signals import Floats, Mask


class Prior(Protocol):
    """Of the amplitudes of a component: N(0, ``sd``^2), or half of it; ``cost``: -log probability of its form.

    Amplitudes beyond ``largest``, or above ``highest``, are impossible.
    """

    @property
    def sd(self) -> float:
        """Of each amplitude."""

    @property
    def positive(self) -> bool:
        """Whether its one amplitude cannot be negative."""

    @property
    def largest(self) -> float:
        """Of its amplitudes, whatever their sign."""

    @property
    def highest(self) -> float:
        """Of its amplitudes."""

    @property
    def cost(self) -> float:
        """Taken off its evidence."""


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


@dataclass(frozen=True)
class _Added:
    """Components (g,) of k columns added to a set, each alone; in the likelihood's own units."""

    gain: Floats  # (g,) in log evidence
    value: Floats  # (g, k) of the amplitudes, x
    covariance: Floats  # (g, k, k) of them, V
    turned: Floats  # (g, k, s) covariance of the set's amplitudes times the products of both, W


def places_of(base_size: int, sizes: Sequence[int]) -> list[NDArray[np.int64]]:
    """Places of the columns of each component, of ``sizes``, behind those of the base."""
    ends = base_size + np.cumsum([0, *sizes])
    return [np.arange(start, end) for start, end in pairwise(ends)]


class SetLikelihood:
    """The likelihood of sets of components.

    Parameters
    ----------
    products
        Of the data and the columns of base and components (1 + p, 1 + p), weighted by K^-1.
    base_precision
        Of the prior of the base's amplitudes (b,); zero where they are free.
    priors
        Of the components.
    places
        Of their columns among the p.
    unit
        What the columns (p,) were divided by.
    """

    def __init__(
        self,
        products: Floats,
        base_precision: Floats,
        priors: Sequence[Prior],
        places: Sequence[NDArray[np.int64]],
        unit: Floats,
    ) -> None:
        self.priors, self.places, self.unit = list(priors), list(places), unit
        self.base_size = len(base_precision)
        self._prior = base_precision
        self._total, self._moment = float(products[0, 0]), products[1:, 0]
        self._information = products[1:, 1:]
        self._widths = np.array([len(own) for own in places])
        self._sds, self._costs, self._largest, self._highest = (
            np.array([getattr(prior, name) for prior in priors]) for name in ("sd", "cost", "largest", "highest")
        )
        self._positive = np.array([prior.positive for prior in priors], dtype=np.bool_)

    def observe(self, weights: Mapping[int, float], value: float) -> None:
        """Add a measurement: the sum of ``weights`` x amplitudes is ``value``, all over its sd.

        ``weights`` by the numbers of components with one column; those that are not in a set add nothing to the sum.
        """
        places = np.array([self.places[index][0] for index in weights], dtype=np.int64)
        each = np.array(list(weights.values()))
        self._information[np.ix_(places, places)] += np.outer(each, each)
        self._moment[places] += each * value

    def _precision(self, chosen: Sequence[int]) -> Floats:
        """Of the prior of base and set."""
        return np.concatenate([self._prior, *(np.full(len(self.places[i]), self.priors[i].sd ** -2.0) for i in chosen)])

    def _set(self, chosen: Sequence[int]) -> tuple[Floats, Floats, Floats]:
        """Places of a set, its information with the prior, and the prior's precision."""
        places = np.concatenate([np.arange(self.base_size), *(self.places[i] for i in chosen)])
        prior = self._precision(chosen)
        return places, self._information[np.ix_(places, places)] + np.diag(prior), prior

    def posterior(self, chosen: Sequence[int]) -> Posterior:
        """Amplitudes and log evidence of the components with numbers in ``chosen``, up to a constant of the data."""
        places, information, prior = self._set(chosen)
        unit = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        scaled = information * np.outer(unit, unit)
        covariance = np.linalg.inv(scaled) * np.outer(unit, unit)
        # solved, not multiplied by the covariance: where two columns have one course, the inverse is mostly rounding
        mean = unit * np.linalg.solve(scaled, unit * self._moment[places])
        volume = float(np.linalg.slogdet(scaled)[1] - 2 * np.log(unit).sum())
        log = -0.5 * (volume - np.log(prior[prior > 0]).sum() + self._total - self._moment[places] @ mean)
        at = self.base_size
        for i in chosen:
            if self.priors[i].positive:
                log += float(log_evidence_of_sign(mean[at] / np.sqrt(covariance[at, at])))
            at += len(self.places[i])
        own = self.unit[places]
        return Posterior(mean / own, covariance / np.outer(own, own), self.base_size, float(log))

    def value(self, chosen: Sequence[int], index: int) -> float:
        """Amplitude of the component ``index``, of one column, in a set that it is in."""
        before = sum(len(self.places[i]) for i in chosen[: chosen.index(index)])
        return float(self.posterior(chosen).mean[self.base_size + before])

    def base(self, chosen: Sequence[int]) -> tuple[Floats, Floats]:
        """Amplitudes of the base beside a set: mean (b,) and covariance (b, b), in own units.

        Unlike in `posterior`, amplitudes of the set that cannot be negative are cut at zero.
        """
        posterior, sizes = self.posterior(chosen), [len(self.places[i]) for i in chosen]
        own = zip(chosen, places_of(self.base_size, sizes), strict=True)
        positive = [int(place) for i, places in own if self.priors[i].positive for place in places]
        mean, covariance = cut_at_zero(posterior.mean, posterior.covariance, positive)
        b = self.base_size
        return mean[:b], covariance[:b, :b]

    def unlimited(self, chosen: Sequence[int]) -> float:
        """Log evidence of the set with numbers in ``chosen``, less the cost of its times, whatever the sizes are."""
        return self.posterior(chosen).log_evidence - sum(self.priors[i].cost for i in chosen)

    def log_evidence(self, chosen: Sequence[int]) -> float:
        """The same; minus infinity where a size is impossible."""
        posterior = self.posterior(chosen)
        possible = np.all(self._are_possible(chosen, posterior.mean[self.base_size :]))
        return posterior.log_evidence - sum(self.priors[i].cost for i in chosen) if possible else -np.inf

    def with_each(self, chosen: Sequence[int], others: Sequence[int]) -> Floats:
        """Log evidence (c,) of the set with each of ``others`` added, as `log_evidence` of the larger set gives it."""
        found, possible = self._with_each(chosen, others)
        return np.where(possible, found, -np.inf)

    def unlimited_with_each(self, chosen: Sequence[int], others: Sequence[int]) -> Floats:
        """The same as `unlimited` gives it."""
        return self._with_each(chosen, others)[0]

    def _with_each(self, chosen: Sequence[int], others: Sequence[int]) -> tuple[Floats, Mask]:
        """Log evidence (c,) of the set with each of ``others`` added, and whether all sizes are possible (c,)."""
        widths, posterior = self._widths[list(others)], self.posterior(chosen)
        found, possible = np.empty(len(others)), np.empty(len(others), dtype=np.bool_)
        for width in np.unique(widths):
            alike = np.flatnonzero(widths == width)
            own = [others[k] for k in alike.tolist()]
            found[alike], possible[alike] = self._with_each_alike(chosen, posterior, own)
        return found, possible

    def _with_each_alike(
        self, chosen: Sequence[int], posterior: Posterior, others: Sequence[int]
    ) -> tuple[Floats, Mask]:
        """`_with_each` for components of equally many columns.

        They change the amplitudes b of the set and their covariance S to b - W x and S + W V W', see `_Added`.
        """
        added, places = self._added(chosen, others), self._set(chosen)[0]
        turned, units = added.turned[:, :, self.base_size :], self.unit[places][self.base_size :]
        before = posterior.mean[self.base_size :] * units
        variance = np.diag(posterior.covariance)[self.base_size :] * units**2
        mean = before - np.einsum("gks,gk->gs", turned, added.value)
        spread = variance + np.einsum("gks,gkl,gls->gs", turned, added.covariance, turned, optimize=True)
        signed = np.array([self.priors[i].positive for i in chosen for _ in self.places[i]], dtype=np.bool_)
        signs = (log_ndtr(mean / np.sqrt(spread)) - log_ndtr(before / np.sqrt(variance)))[:, signed].sum(axis=1)
        own = list(others)
        costs = sum(self.priors[i].cost for i in chosen) + self._costs[own]
        value = added.value / self.unit[self._places_of(others)]
        possible = np.all(self._are_possible(chosen, mean / units), axis=1)
        possible &= np.all((np.abs(value) <= self._largest[own, None]) & (value <= self._highest[own, None]), axis=1)
        return posterior.log_evidence + added.gain + signs - costs, possible

    def _places_of(self, others: Sequence[int]) -> NDArray[np.int64]:
        """Places (g, k) of the columns of ``others`` (g,), which have equally many."""
        width = len(self.places[others[0]]) if others else 1
        return np.array([self.places[i] for i in others], dtype=np.int64).reshape(len(others), width)

    def _added(self, chosen: Sequence[int], others: Sequence[int]) -> "_Added":
        """``others`` (g,) of k columns each, each alone beside a set; costs not counted."""
        places, information, _ = self._set(chosen)
        new = self._places_of(others)
        crossed = self._information[np.ix_(places, new.ravel())]
        weights = np.linalg.solve(information, np.column_stack([crossed, self._moment[places]]))
        across, turned = (x.T.reshape(*new.shape, len(places)) for x in (crossed, weights[:, :-1]))
        score = self._moment[new] - across @ weights[:, -1]
        usual = self._sds[list(others)]
        precision = self._information[new[:, :, None], new[:, None, :]] - across @ turned.transpose(0, 2, 1)
        diagonal = np.einsum("gkk->gk", precision)
        diagonal[:] = np.maximum(diagonal, 0.0) + usual[:, None] ** -2.0
        value, covariance = np.linalg.solve(precision, score[:, :, None])[:, :, 0], np.linalg.inv(precision)
        volume = np.linalg.slogdet(precision * usual[:, None, None] ** 2)[1]
        positive = self._positive[list(others)]
        signs = np.where(positive, log_evidence_of_sign(value[:, 0] / np.sqrt(covariance[:, 0, 0])), 0.0)
        return _Added(0.5 * np.sum(score * value, axis=1) - 0.5 * volume + signs, value, covariance, turned)

    def _are_possible(self, chosen: Sequence[int], sizes: Floats) -> Mask:
        """Whether the amplitudes (..., s) of a set are."""
        own = [i for i in chosen for _ in self.places[i]]
        possible: Mask = (np.abs(sizes) <= self._largest[own]) & (sizes <= self._highest[own])
        return possible

    def gains(self, chosen: Sequence[int], candidates: Sequence[int]) -> Judged:
        """What each of ``candidates`` with one column adds to a set, costs not counted."""
        added = self._added(chosen, candidates)
        return Judged(added.gain, added.value[:, 0], np.sqrt(added.covariance[:, 0, 0]))

    def imitated(self, chosen: Sequence[int], index: int) -> Floats:
        """Change (p,) of the amplitudes of base and set, in own units, by a unit of a component that is left out."""
        places, information, _ = self._set(chosen)
        (new,) = self.places[index]
        change: Floats = np.linalg.solve(information, self._information[places, new])
        in_own_units: Floats = change / self.unit[places]
        return in_own_units

    def off(self, chosen: Sequence[int], products: Floats) -> tuple[Floats, Floats]:
        """Products (c, c) and scores (c,) of further columns, off a set of components.

        ``products`` (1 + s + c, 1 + s + c) are those of the data, the s columns of base and set, and the further ones.
        """
        places, information, _ = self._set(chosen)
        split = 1 + len(places)
        cross = products[1:split, split:]
        weights = np.linalg.solve(information, np.column_stack([cross, self._moment[places]]))
        score: Floats = products[split:, 0] - cross.T @ weights[:, -1]
        return products[split:, split:] - cross.T @ weights[:, :-1], score

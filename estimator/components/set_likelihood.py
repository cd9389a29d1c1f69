"""Compute the evidence of any set of terms from the products of all their columns, which are computed once.

The data are y = X b + noise of covariance K, with a Gaussian prior of covariance P for the amplitudes b. With the
products of columns weighted by K^-1, and the posterior mean b^,

    log p(y | set) = 1/2 (log|P^-1| - log|X'K^-1 X + P^-1| - y'K^-1 y + b^' (X'K^-1 X + P^-1) b^) + log prior of signs

up to a constant that all sets share. The base columns are in every set.
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
    """Prior of the amplitudes of a term: N(0, ``sd``^2), restricted to positive values if ``positive``."""

    @property
    def sd(self) -> float:
        """Standard deviation of each amplitude."""

    @property
    def positive(self) -> bool:
        """True if its one amplitude cannot be negative."""

    @property
    def max_size(self) -> float:
        """Largest possible modulus of an amplitude."""

    @property
    def max_positive_size(self) -> float:
        """Largest possible amplitude."""

    @property
    def cost(self) -> float:
        """Minus the log probability of its times [nats]; subtracted from its evidence."""


@dataclass(frozen=True)
class Posterior:
    """Mean (p,) and covariance (p, p) of the amplitudes of the base, then those of a set, in their physical units."""

    mean: Floats
    covariance: Floats
    log_evidence: float


@dataclass(frozen=True)
class TermGains:
    """Terms of one column, each added alone to a set: gain in log evidence, value and sd, all (c,)."""

    gain: Floats
    value: Floats
    sd: Floats


@dataclass(frozen=True, kw_only=True)
class _Update:
    """Terms (g,) of k columns, each added alone to a set; in the scaled units of the likelihood.

    The amplitudes b of the set, without the base, change to b - W x, and their covariance S to S + W V W'. V is the
    covariance of the added amplitudes x, and W is S times the products of the columns of the set and the added ones.
    """

    gain: Floats  # (g,) in log evidence
    value: Floats  # (g, k) of the amplitudes, x
    sd: Floats  # (g,) of the first of them
    moved: Floats  # (g, s) W x
    widened: Floats  # (g, s) diagonal of W V W'


def term_columns_of(base_size: int, sizes: Sequence[int]) -> list[NDArray[np.int64]]:
    """Indices of the columns of each term, with ``sizes`` columns, after those of the base."""
    ends = base_size + np.cumsum([0, *sizes])
    return [np.arange(start, end) for start, end in pairwise(ends)]


class SetLikelihood:
    """Likelihood of sets of terms.

    Parameters
    ----------
    products
        Products (1 + p, 1 + p) of the data and the p columns of base and terms, weighted by K^-1.
    base_precision
        Prior precision (b,) of the amplitudes of the base; zero where they are free.
    priors
        Priors of the terms.
    term_columns
        Indices of the columns of each term among the p.
    unit
        Divisor (p,) of each column; amplitudes are divided by it to get physical units.
    """

    def __init__(
        self,
        products: Floats,
        base_precision: Floats,
        priors: Sequence[Prior],
        term_columns: Sequence[NDArray[np.int64]],
        unit: Floats,
    ) -> None:
        self.priors, self.term_columns, self.unit = list(priors), list(term_columns), unit
        self.base_size = len(base_precision)
        self._prior = base_precision
        self._total, self._moment = float(products[0, 0]), products[1:, 0]
        self._information = products[1:, 1:]
        self._widths = np.array([len(columns) for columns in term_columns])
        self._sds, self._costs, self._max_sizes, self._max_positive_sizes = (
            np.array([getattr(prior, name) for prior in priors])
            for name in ("sd", "cost", "max_size", "max_positive_size")
        )
        self._positive = np.array([prior.positive for prior in priors], dtype=np.bool_)

    def observe(self, weights: Mapping[int, float], value: float) -> None:
        """Add a measurement of a weighted sum of amplitudes: its ``value`` and ``weights``, all divided by its sd.

        ``weights`` are given by the number of a term with one column. Terms outside a set add nothing.
        """
        columns = np.array([self.term_columns[index][0] for index in weights], dtype=np.int64)
        factors = np.array(list(weights.values()))
        self._information[np.ix_(columns, columns)] += np.outer(factors, factors)
        self._moment[columns] += factors * value

    def _precision(self, chosen: Sequence[int]) -> Floats:
        """Prior precision (p,) of the amplitudes of base and set."""
        return np.concatenate(
            [self._prior, *(np.full(len(self.term_columns[i]), self.priors[i].sd ** -2.0) for i in chosen)]
        )

    def _set(self, chosen: Sequence[int]) -> tuple[NDArray[np.int64], Floats, Floats]:
        """Indices (p,) of base and set, their information (p, p) with the prior, and their prior precision (p,)."""
        columns = np.concatenate([np.arange(self.base_size), *(self.term_columns[i] for i in chosen)])
        prior = self._precision(chosen)
        return columns, self._information[np.ix_(columns, columns)] + np.diag(prior), prior

    def posterior(self, chosen: Sequence[int]) -> Posterior:
        """Posterior of the set ``chosen``, and its log evidence up to a constant of the data; costs not counted."""
        columns, information, prior = self._set(chosen)
        unit = 1 / np.sqrt(np.maximum(np.diag(information), 1e-300))
        scaled = information * np.outer(unit, unit)
        covariance = np.linalg.inv(scaled) * np.outer(unit, unit)
        # solved, not multiplied by the covariance: where two columns have one course, the inverse is mostly rounding
        mean = unit * np.linalg.solve(scaled, unit * self._moment[columns])
        volume = float(np.linalg.slogdet(scaled)[1] - 2 * np.log(unit).sum())
        log = -0.5 * (volume - np.log(prior[prior > 0]).sum() + self._total - self._moment[columns] @ mean)
        at = self.base_size
        for i in chosen:
            if self.priors[i].positive:
                log += float(log_evidence_of_sign(mean[at] / np.sqrt(covariance[at, at])))
            at += len(self.term_columns[i])
        units = self.unit[columns]
        return Posterior(mean / units, covariance / np.outer(units, units), float(log))

    def amplitude(self, chosen: Sequence[int], index: int) -> float:
        """Posterior mean of the amplitude of the term ``index``, of one column, in a set that contains it."""
        start = sum(len(self.term_columns[i]) for i in chosen[: chosen.index(index)])
        return float(self.posterior(chosen).mean[self.base_size + start])

    def base_posterior(self, chosen: Sequence[int]) -> tuple[Floats, Floats]:
        """Mean (b,) and covariance (b, b) of the amplitudes of the base given a set, in physical units.

        Unlike in `posterior`, the distribution is truncated at zero for amplitudes that cannot be negative.
        """
        posterior, sizes = self.posterior(chosen), [len(self.term_columns[i]) for i in chosen]
        columns_of_chosen = zip(chosen, term_columns_of(self.base_size, sizes), strict=True)
        positive = [int(column) for i, columns in columns_of_chosen if self.priors[i].positive for column in columns]
        mean, covariance = cut_at_zero(posterior.mean, posterior.covariance, positive)
        b = self.base_size
        return mean[:b], covariance[:b, :b]

    def log_evidence(self, chosen: Sequence[int], check_limits: bool = True) -> float:
        """Log evidence of the set ``chosen``, less its costs.

        With ``check_limits`` it is minus infinity if a magnitude is impossible.
        """
        posterior = self.posterior(chosen)
        if check_limits and not np.all(self._are_possible(chosen, posterior.mean[self.base_size :])):
            return -np.inf
        return posterior.log_evidence - sum(self.priors[i].cost for i in chosen)

    def log_evidence_with(self, chosen: Sequence[int], added: Sequence[int], check_limits: bool = True) -> Floats:
        """`log_evidence` (c,) of the set with each of ``added``, one at a time."""
        evidence, possible = self._evidence_with(chosen, added)
        return np.where(possible, evidence, -np.inf) if check_limits else evidence

    def _evidence_with(self, chosen: Sequence[int], added: Sequence[int]) -> tuple[Floats, Mask]:
        """Log evidence (c,) of the set with each of ``added``, and whether all magnitudes are possible (c,)."""
        widths, posterior = self._widths[list(added)], self.posterior(chosen)
        evidence, possible = np.empty(len(added)), np.empty(len(added), dtype=np.bool_)
        for width in np.unique(widths):
            alike = np.flatnonzero(widths == width)
            group = [added[k] for k in alike.tolist()]
            evidence[alike], possible[alike] = self._evidence_with_alike(chosen, posterior, group)
        return evidence, possible

    def _evidence_with_alike(
        self, chosen: Sequence[int], posterior: Posterior, added: Sequence[int]
    ) -> tuple[Floats, Mask]:
        """`_evidence_with` for terms with equal numbers of columns."""
        update, units = self._updated(chosen, added), self.unit[self._set(chosen)[0]][self.base_size :]
        previous = posterior.mean[self.base_size :] * units
        variance = np.diag(posterior.covariance)[self.base_size :] * units**2
        mean, spread = previous - update.moved, variance + update.widened
        signed = np.array([self.priors[i].positive for i in chosen for _ in self.term_columns[i]], dtype=np.bool_)
        signs = (log_ndtr(mean / np.sqrt(spread)) - log_ndtr(previous / np.sqrt(variance)))[:, signed].sum(axis=1)
        numbers = list(added)
        costs = sum(self.priors[i].cost for i in chosen) + self._costs[numbers]
        value = update.value / self.unit[self._columns_of(added)]
        possible = np.all(self._are_possible(chosen, mean / units), axis=1)
        possible &= np.all(
            (np.abs(value) <= self._max_sizes[numbers, None]) & (value <= self._max_positive_sizes[numbers, None]),
            axis=1,
        )
        return posterior.log_evidence + update.gain + signs - costs, possible

    def _columns_of(self, added: Sequence[int]) -> NDArray[np.int64]:
        """Indices (g, k) of the columns of ``added`` (g,), which have k columns each."""
        width = len(self.term_columns[added[0]]) if added else 1
        return np.array([self.term_columns[i] for i in added], dtype=np.int64).reshape(len(added), width)

    def _updated(self, chosen: Sequence[int], added: Sequence[int]) -> "_Update":
        """Add each of ``added`` (g,), of k columns each, alone to a set; costs are not counted."""
        columns, information, _ = self._set(chosen)
        new = self._columns_of(added)
        crossed = self._information[np.ix_(columns, new.ravel())]
        weights = np.linalg.solve(information, np.column_stack([crossed, self._moment[columns]]))
        across, turned = (x.T.reshape(*new.shape, len(columns)) for x in (crossed, weights[:, :-1]))
        score = self._moment[new] - across @ weights[:, -1]
        usual = self._sds[list(added)]
        precision = self._information[new[:, :, None], new[:, None, :]] - across @ turned.transpose(0, 2, 1)
        diagonal = np.einsum("gkk->gk", precision)
        diagonal[:] = np.maximum(diagonal, 0.0) + usual[:, None] ** -2.0
        of_set, first = turned[:, :, self.base_size :], np.broadcast_to(np.eye(new.shape[1])[:, :1], (*new.shape, 1))
        solved = np.linalg.solve(precision, np.concatenate([score[:, :, None], first, of_set], axis=2))
        value, sd = solved[:, :, 0], np.sqrt(solved[:, 0, 1])
        volume = np.linalg.slogdet(precision * usual[:, None, None] ** 2)[1]
        signs = np.where(self._positive[list(added)], log_evidence_of_sign(value[:, 0] / sd), 0.0)
        return _Update(
            gain=0.5 * np.sum(score * value, axis=1) - 0.5 * volume + signs,
            value=value,
            sd=sd,
            moved=np.einsum("gks,gk->gs", of_set, value),
            widened=np.einsum("gks,gks->gs", of_set, solved[:, :, 2:]),
        )

    def _are_possible(self, chosen: Sequence[int], sizes: Floats) -> Mask:
        """True (..., s) where an amplitude of a set is within its limits."""
        term_of_column = [i for i in chosen for _ in self.term_columns[i]]
        possible: Mask = (np.abs(sizes) <= self._max_sizes[term_of_column]) & (
            sizes <= self._max_positive_sizes[term_of_column]
        )
        return possible

    def gains(self, chosen: Sequence[int], added: Sequence[int]) -> TermGains:
        """Gain of each of ``added``, of one column, added alone to a set; costs are not counted."""
        update = self._updated(chosen, added)
        return TermGains(update.gain, update.value[:, 0], update.sd)

    def omission_bias(self, chosen: Sequence[int], index: int) -> Floats:
        """Omitted-variable bias (p,) of base and set, in physical units, per scaled unit of an omitted term."""
        columns, information, _ = self._set(chosen)
        (new,) = self.term_columns[index]
        bias: Floats = np.linalg.solve(information, self._information[columns, new]) / self.unit[columns]
        return bias

    def eliminated(self, chosen: Sequence[int], products: Floats) -> tuple[Floats, Floats]:
        """Products (c, c) and scores (c,) of further columns, with base and set eliminated.

        ``products`` (1 + s + c, 1 + s + c) are those of the data, of the s columns of base and set, and of the further
        columns.
        """
        columns, information, _ = self._set(chosen)
        split = 1 + len(columns)
        cross = products[1:split, split:]
        weights = np.linalg.solve(information, np.column_stack([cross, self._moment[columns]]))
        score: Floats = products[split:, 0] - cross.T @ weights[:, -1]
        return products[split:, split:] - cross.T @ weights[:, :-1], score

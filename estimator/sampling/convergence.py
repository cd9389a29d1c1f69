"""Convergence of a sampler, and its effective number of independent draws.

Rank-normalised split R-hat, bulk and tail effective sample size: Vehtari, Gelman, Simpson, Carpenter, Buerkner,
"Rank-normalization, folding, and localization: an improved R-hat", Bayesian Analysis 16 (2021).
"""

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from statistics import NormalDist

import numpy as np

from estimator.signals import Floats


@dataclass(frozen=True)
class Diagnosis:
    """Convergence diagnostics of one parameter; NaN if they cannot be computed, which never counts as converged."""

    r_hat: float  # the larger of the rank-normalised and the folded one
    ess_bulk: float  # effective number of independent draws, for the centre
    draws: Floats = field(repr=False)  # (chains, draws); none where nothing can be computed

    @cached_property
    def ess_tail(self) -> float:
        """Effective number of independent draws for the 5 % and 95 % quantiles, the smaller of the two."""
        if not self.draws.size:
            return np.nan
        halves = _split(self.draws)
        return min(_effective((halves <= q).astype(float)) for q in np.quantile(self.draws, (0.05, 0.95)))


def diagnose(draws: Floats) -> Diagnosis:
    """Compute the diagnostics of the ``draws`` (chains, draws) of one parameter."""
    if draws.shape[0] < 2 or draws.shape[1] < 4 or not np.isfinite(draws).all() or np.ptp(draws) == 0:
        return Diagnosis(np.nan, np.nan, np.empty((0, 0)))
    halves = _split(draws)
    scores = _rank_normal(halves)
    folded = _rank_normal(np.abs(halves - np.median(halves)))
    r_hat = max(_potential_scale_reduction(scores), _potential_scale_reduction(folded))
    return Diagnosis(r_hat, _effective(scores), draws)


def _split(draws: Floats) -> Floats:
    half = draws.shape[1] // 2
    return np.concatenate([draws[:, :half], draws[:, -half:]])


def _rank_normal(draws: Floats) -> Floats:
    """Normal scores of the ranks over all chains, with Blom's offset; equal draws have their mean rank."""
    order = np.argsort(draws, axis=None)
    ordered = draws.ravel()[order]
    first = np.flatnonzero(np.concatenate([[True], ordered[1:] != ordered[:-1]]))
    count = np.diff(first, append=draws.size)
    scores = np.empty(draws.size)
    # Draws first .. first + count - 1 in order share the mean of ranks first + 1 .. first + count.
    scores[order] = np.repeat(_normal_scores(draws.size)[2 * first + count - 1], count)
    return scores.reshape(draws.shape)


@lru_cache(maxsize=4)
def _normal_scores(size: int) -> Floats:
    """Normal scores (2 size - 1,) of the ranks 1, 1.5 ... ``size``; scipy.special takes 0.1 s to import."""
    ranks = np.arange(2, 2 * size + 1) / 2
    return np.array(list(map(NormalDist().inv_cdf, ((ranks - 0.375) / (size + 0.25)).tolist())))


def _potential_scale_reduction(draws: Floats) -> float:
    n = draws.shape[1]
    within = draws.var(axis=1, ddof=1).mean()
    between = n * draws.mean(axis=1).var(ddof=1)
    return float(np.sqrt((between / within + n - 1) / n)) if within > 0 else np.inf


def _effective(chains: Floats) -> float:
    """Effective sample size of split ``chains`` (m, n), by Geyer's initial monotone sequence over all of them."""
    m, n = chains.shape
    centred = chains - chains.mean(axis=1, keepdims=True)
    size = 1 << (2 * n - 1).bit_length()  # a power of 2, for speed; twice as long as the chains, or they wrap round
    spectrum = np.fft.rfft(centred, size)
    power = (spectrum.real**2 + spectrum.imag**2).mean(axis=0)
    covariance = np.fft.irfft(power, size)[:n] / n  # mean over the chains
    within = float(covariance[0]) * n / (n - 1)
    total = within * (n - 1) / n + float(chains.mean(axis=1).var(ddof=1))
    if total <= 0:
        return np.nan
    rho = 1 - (within - covariance) / total
    rho[0] = 1.0
    pairs = rho[: 2 * (n // 2)].reshape(-1, 2).sum(axis=1)
    negative = np.flatnonzero(pairs <= 0)
    stop = min(int(negative[0]) if len(negative) else n, (n - 3) // 2)
    monotone = np.minimum.accumulate(pairs[:stop])
    tau = -1 + 2 * float(monotone.sum()) + max(float(rho[2 * stop]), 0.0)
    return float(m * n / max(tau, 1 / np.log10(m * n)))

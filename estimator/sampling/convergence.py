"""Has the sampler converged, and how many independent draws are its draws worth.

Rank-normalised split R-hat, bulk and tail effective sample size: Vehtari, Gelman, Simpson, Carpenter, Buerkner,
"Rank-normalization, folding, and localization: an improved R-hat", Bayesian Analysis 16 (2021).
All functions take draws (chains, draws) of one parameter.
"""

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.special import ndtri
from scipy.stats import rankdata

from estimator.signals import Floats


def _split(draws: Floats) -> Floats:
    half = draws.shape[1] // 2
    return np.concatenate([draws[:, :half], draws[:, -half:]])


def _rank_normal(draws: Floats) -> Floats:
    """Normal scores of the ranks over all chains (Blom's offset)."""
    ranks = rankdata(draws, method="average").reshape(draws.shape)
    return ndtri((ranks - 0.375) / (draws.size + 0.25))


def _usable(draws: Floats) -> bool:
    enough = draws.shape[0] >= 2 and draws.shape[1] >= 4
    return enough and bool(np.isfinite(draws).all()) and float(np.ptp(draws)) > 0


def _potential_scale_reduction(draws: Floats) -> float:
    n = draws.shape[1]
    within = draws.var(axis=1, ddof=1).mean()
    between = n * draws.mean(axis=1).var(ddof=1)
    return float(np.sqrt((between / within + n - 1) / n)) if within > 0 else np.inf


def r_hat(draws: Floats) -> float:
    """Largest of the rank-normalised and the folded split R-hat; NaN where it cannot be computed."""
    if not _usable(draws):
        return np.nan
    halves = _split(draws)
    folded = np.abs(halves - np.median(halves))
    return max(_potential_scale_reduction(_rank_normal(x)) for x in (halves, folded))


def _effective(chains: Floats) -> float:
    """Geyer's initial monotone sequence over the combined chains; ``chains`` are split already."""
    m, n = chains.shape
    centred = chains - chains.mean(axis=1, keepdims=True)
    size = next_fast_len(2 * n)
    spectrum = rfft(centred, size)
    covariance = irfft(spectrum * spectrum.conj(), size)[:, :n] / n
    within = float(covariance[:, 0].mean()) * n / (n - 1)
    total = within * (n - 1) / n + (float(chains.mean(axis=1).var(ddof=1)) if m > 1 else 0.0)
    if total <= 0:
        return np.nan
    rho = 1 - (within - covariance.mean(axis=0)) / total
    rho[0] = 1.0
    pairs = rho[: 2 * (n // 2)].reshape(-1, 2).sum(axis=1)
    negative = np.flatnonzero(pairs <= 0)
    stop = min(int(negative[0]) if len(negative) else n, (n - 3) // 2)
    monotone = np.minimum.accumulate(pairs[:stop])
    tau = -1 + 2 * float(monotone.sum()) + max(float(rho[2 * stop]), 0.0)
    return float(m * n / max(tau, 1 / np.log10(m * n)))


def ess_bulk(draws: Floats) -> float:
    """Effective sample size for the centre of the distribution; NaN where it cannot be computed."""
    return _effective(_rank_normal(_split(draws))) if _usable(draws) else np.nan


def ess_tail(draws: Floats) -> float:
    """Effective sample size for the 5 % and 95 % quantiles, the smaller of the two."""
    if not _usable(draws):
        return np.nan
    return min(_effective(_split((draws <= np.quantile(draws, q)).astype(float))) for q in (0.05, 0.95))

"""Variance of sums of autocorrelated values, from their lowest cosine transforms.

Equal-weighted cosines: Mueller 2004; Lazarus, Lewis, Stock, Watson 2018. The estimate is chi-squared distributed with
as many degrees of freedom as there are cosines.
"""

import numpy as np

from estimator.signals import Floats

MIN_COSINES = 16  # degrees of freedom of a long-run variance
TIMES_PER_COSINE = 3.0  # autocorrelation times that one cosine transform must span


def autocorrelation_time(x: Floats) -> float:
    """Integrated autocorrelation time [samples] of ``x`` (n,), at least 1, with Sokal's window of 5 times that time."""
    n = len(x)
    size = 1 << (2 * n - 1).bit_length()  # a power of 2, for speed
    spectrum = np.fft.rfft(x - x.mean(), size)
    covariance = np.fft.irfft(np.abs(spectrum) ** 2, size)[:n]
    if covariance[0] <= 0:
        return 1.0
    tau = 2 * np.cumsum(covariance / covariance[0]) - 1
    enough = np.flatnonzero(np.arange(n) >= 5 * tau)
    return max(float(tau[enough[0]] if len(enough) else tau[-1]), 1.0)


def cosine_transform(x: Floats, count: int) -> Floats:
    """Orthonormal cosine transforms 1 .. ``count`` <= n / 2, of type II, of the columns of ``x`` (n, p).

    Computed by the Fourier transform of the even rows followed by the reversed odd ones (Makhoul 1980). `scipy.fft.dct`
    caches tables of the last sixteen lengths; here every length differs, so it would hold 27 MB.
    """
    n = len(x)
    turn = np.exp(-0.5j * np.pi * np.arange(1, count + 1) / n) * np.sqrt(2 / n)
    spectrum = np.fft.rfft(np.concatenate([x[::2], x[1::2][::-1]]), axis=0)[1 : count + 1]
    transform: Floats = (spectrum * turn[:, None]).real
    return transform


def long_run_variance(values: Floats) -> tuple[float, float]:
    """Variance of the sum of autocorrelated ``values`` (n,) of mean zero, and its degrees of freedom."""
    n = len(values)
    count = int(np.clip(n / (TIMES_PER_COSINE * autocorrelation_time(values)), MIN_COSINES, 0.6 * n ** (5 / 6)))
    count = max(min(count, n // 2), 1)
    return n * float(np.mean(cosine_transform(values[:, None], count) ** 2)), float(count)

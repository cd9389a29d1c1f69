"""Recursive filters as banded triangular systems; `scipy.signal.lfilter` takes 59 MB and 0.6 s to import."""

import numpy as np
from scipy.linalg.lapack import dtbtrs

from estimator.signals import Floats


def recursive(signal: Floats, recursion: Floats) -> Floats:
    """Solve sum_k recursion[k] y[t - k] = signal[t] for y (n,), zero before the start; recursion[0] is 1."""
    band = np.repeat(recursion[:, None], len(signal), axis=1)
    solution: Floats = dtbtrs(band, signal[:, None], uplo="L", diag="U")[0][:, 0]
    return solution

"""Recursive filters as banded triangular systems; `scipy.signal.lfilter` takes 59 MB and 0.6 s to import."""

from math import exp
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg.lapack import dtbtrs, ztbtrs

from estimator.signals import Floats

Values = TypeVar("Values", Floats, NDArray[np.complex128])


def recursive(signal: Values, recursion: Values) -> Values:
    """Solve sum_k recursion[k] y[t - k] = signal[t] for y (n,), zero before the start; recursion[0] is 1."""
    band = np.repeat(recursion[:, None], len(signal), axis=1)
    solve = ztbtrs if np.iscomplexobj(band) else dtbtrs
    solution: Values = solve(band, signal[:, None], uplo="L", diag="U")[0][:, 0]
    return solution


def low_passed(signal: Floats, initial: float, step: float, time: float) -> Floats:
    """Filter a ``signal`` (n,) by a first-order low-pass with the time constant ``time`` [s].

    ``step`` [s] is the sampling interval, and ``initial`` the output one step before the first.
    """
    keep = exp(-step / time)
    return recursive(np.concatenate([[initial], (1.0 - keep) * signal]), np.array([1.0, -keep]))[1:]

"""Mean slope of parts of the road by one drive alone, without the prior of the slopes.

Given the coefficients beta, the mean slope of a part is Gaussian with posterior mean x and variance V. Its prior has
mean 0 and variance P. The estimate from the drive alone, and its variance, are

    z = x U / V,   U = 1 / (1/V - 1/P)

so that drives can be combined without counting the prior once a drive. x depends on beta, whose uncertainty moves the
slopes of all parts together: a rolling resistance that is too large makes the whole road too flat. This gives

    common variance = (U / V)^2 dx' cov(beta) dx,   dx = dx/dbeta

It is separate from U, because more passes do not reduce it.
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from estimator.estimation.road_fit import RoadFit
from estimator.estimation.road_likelihood import Likelihood
from estimator.model.conditioned import Conditioned
from estimator.model.linear_gaussian import Factor
from estimator.signals import Floats
from estimator.strides import Strides

MAX_SHARE = 0.9  # of its prior variance that may be left of a slope: with more, the drive shows nothing of it
TOGETHER = 64  # parts whose variances are computed at once: bounds the memory


@dataclass(frozen=True)
class MeanSlopes:
    """Mean ``slope`` [1] (k,), the sine, of parts of a road; ``own`` sd (k,) and ``common`` sd (k,); see the module.

    NaN where the drive shows nothing of a part.
    """

    slope: Floats
    own: Floats
    common: Floats


def mean_slopes(strides: Strides, found: RoadFit, parts: NDArray[np.int64]) -> MeanSlopes:
    """Mean slopes of parts of the road under ``strides``, all of those that were fitted.

    ``parts`` (n,) is the number from 0 of the part that each stride belongs to, -1 for none.
    """
    scales = found.scales
    number = int(parts.max(initial=-1)) + 1
    model = scales.model_of(strides)
    if model.is_level or not number:
        return MeanSlopes(*np.full((3, number), np.nan))
    likelihood = Likelihood(model, found.terms, found.road_load, scales.lag, found.departures, found.taken)
    conditioned = Conditioned.of(model, scales.values)
    data = likelihood.data.copy()
    data[:, 0] -= data[:, 1:] @ (found.beta * likelihood.unit)
    solved = conditioned.factor.solve(model.gathered(data / conditioned.variance[:, None]))
    averages = model.averages(strides, parts)
    answers = averages @ solved
    after, before = _variances(averages, conditioned.factor), _variances(averages, model.slopes_before(scales.values))
    covariance = found.covariance * np.outer(likelihood.unit, likelihood.unit)
    common = np.einsum("ki,ij,kj->k", answers[:, 1:], covariance, answers[:, 1:])
    shown = after < MAX_SHARE * before
    stretch = np.where(shown, 1 / (1 - after / before), np.nan)
    return MeanSlopes(answers[:, 0] * stretch, np.sqrt(after * stretch), np.sqrt(common) * stretch)


def _variances(averages: sp.csr_matrix, factor: Factor) -> Floats:
    """Variance (k,) of each of the linear maps (k, size) of unknowns whose precision has this factor."""
    pieces = []
    for i in range(0, averages.shape[0], TOGETHER):
        whitened = factor.whiten(averages[i : i + TOGETHER].T.toarray())
        pieces.append(np.einsum("ij,ij->j", whitened, whitened))
    return np.concatenate(pieces)

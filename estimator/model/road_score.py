"""How the evidence of a road model changes with the scales of road and noise.

With the unknowns x and the coefficients beta integrated out, the derivative of the log evidence by a scale is the
posterior mean of that of log p(data, x, beta) (Fisher's identity), which needs second moments within the band alone.
Its second derivative is near minus the average information (Gilmour, Thompson & Cullis 1995): with V the covariance
of the data and V_i its derivative by the logarithm of scale i,

    1/2 r_i' V^-1 r_j,   r_i = V_i V^-1 data

which is that of the score, observed and expected, on average. It is never negative.
"""

from dataclasses import dataclass

import numpy as np

from estimator.model.conditioned import Conditioned
from estimator.model.linear_gaussian import add_squares, both_triangles
from estimator.signals import Floats


@dataclass(frozen=True)
class Score:
    """By the logarithms of the scales: ``gradient`` (k,) of the log evidence and its average ``information`` (k, k)."""

    gradient: Floats
    information: Floats


def score(conditioned: Conditioned, scales: Floats, data: Floats, beta: Floats, precision: Floats) -> Score:
    """At ``scales`` (k,), which the model is ``conditioned`` with.

    Parameters
    ----------
    conditioned
        The model with these scales.
    scales
        In the order of `RoadModel.scales`.
    data
        Data, and columns of the coefficients (n, 1 + p).
    beta, precision
        Posterior mean (p,) of the coefficients and inverse of their covariance (p, p).
    """
    model, variance = conditioned.model, conditioned.variance
    unit = 1 / np.sqrt(np.diag(precision))
    spread = unit[:, None] * np.linalg.inv(np.linalg.cholesky(precision * np.outer(unit, unit))).T
    columns = np.column_stack([data[:, 0] - data[:, 1:] @ beta, data[:, 1:] @ spread])
    unknowns = conditioned.factor.solve(model.gathered(columns / variance[:, None]))
    rest = columns - model.observed(unknowns)
    moments = both_triangles(conditioned.factor.covariance())
    misfit = np.einsum("ij,ij->i", rest, rest) + model.variance(moments)
    add_squares(moments, unknowns)

    by = model.variances_by(scales)
    gradient = 0.5 * (misfit / variance - 1) / variance @ by
    for acting in model.acting(scales):
        gradient += acting.process.score(moments, acting.sd, acting.memory) @ acting.by
    answers = _changed(conditioned, scales, unknowns[:, 0], rest[:, 0])
    shared = (rest[:, 1:] / variance[:, None]).T @ answers
    return Score(gradient, 0.5 * (conditioned.gram(answers) - shared.T @ shared))


def changed_by_scales(conditioned: Conditioned, scales: Floats, residual: Floats) -> Floats:
    """V_i V^-1 times a residual (sum of counts,), for each scale i: (sum of counts, k)."""
    unknowns = conditioned.unknowns(residual)
    return _changed(conditioned, scales, unknowns, residual - conditioned.model.observed(unknowns))


def _changed(conditioned: Conditioned, scales: Floats, unknowns: Floats, rest: Floats) -> Floats:
    """The same, for a residual's posterior mean of the unknowns (size,) and the ``rest`` that it leaves."""
    model = conditioned.model
    answer = np.zeros((model.size, len(scales)))  # of the unknowns, to the covariance's change
    for acting in model.acting(scales):
        places = acting.process.places
        answer[places] += acting.process.response(unknowns[places], acting.sd, acting.memory) @ acting.by
    changed: Floats = model.observed(answer) + model.variances_by(scales) * (rest / conditioned.variance)[:, None]
    return changed

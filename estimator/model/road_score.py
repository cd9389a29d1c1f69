"""Derivatives of the log evidence of a road model by the scales of road and noise.

The unknowns x and the coefficients beta are integrated out. The derivative of the log evidence by a scale is then the
posterior mean of that of log p(data, x, beta) (Fisher's identity). It needs second moments within the band alone. The
second derivative is near minus the average information (Gilmour, Thompson & Cullis 1995)

    1/2 r_i' V^-1 r_j,   r_i = V_i V^-1 data

with V the covariance of the data and V_i its derivative by the logarithm of scale i. This is the average of the
observed and the expected information. It is never negative.
"""

from dataclasses import dataclass

import numpy as np

from estimator.model.conditioned import Conditioned
from estimator.model.linear_gaussian import add_squares, both_triangles
from estimator.signals import Floats


@dataclass(frozen=True)
class Score:
    """``gradient`` (k,) of the log evidence by the log scales, and its average ``information`` (k, k)."""

    gradient: Floats
    information: Floats


def score(conditioned: Conditioned, scales: Floats, data: Floats, beta: Floats, precision: Floats) -> Score:
    """Score of a road model at its scales.

    Parameters
    ----------
    conditioned
        Model conditioned with these scales.
    scales
        Scales (k,), in the order of `RoadModel.scales`.
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
    """Products V_i V^-1 residual (sum of counts, k), for each scale i and a residual (sum of counts,)."""
    unknowns = conditioned.unknowns(residual)
    return _changed(conditioned, scales, unknowns, residual - conditioned.model.observed(unknowns))


def average_information(products: Floats, moments: Floats, precision: Floats) -> Floats:
    """Average information (k, k) on the logarithms of k scales, with the coefficients integrated out.

    From the ``products`` D' K^-1 D (k, k) of the changes D by each of the scales, and X' K^-1 D: ``moments`` (p, k),
    for the columns X of p coefficients, whose information is ``precision`` (p, p).
    """
    information: Floats = 0.5 * (products - moments.T @ np.linalg.solve(precision, moments))
    return information


def _changed(conditioned: Conditioned, scales: Floats, unknowns: Floats, rest: Floats) -> Floats:
    """Products of `changed_by_scales`, given the posterior mean ``unknowns`` (size,) and the ``rest`` it leaves."""
    model = conditioned.model
    answer = np.zeros((model.size, len(scales)))  # of the unknowns, to the covariance's change
    for acting in model.acting(scales):
        places = acting.process.places
        answer[places] += acting.process.response(unknowns[places], acting.sd, acting.memory) @ acting.by
    changed: Floats = model.observed(answer) + model.variances_by(scales) * (rest / conditioned.variance)[:, None]
    return changed

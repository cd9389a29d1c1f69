"""The road load averaged over the shapes that an effect may have on the drive.

A depends on the shape: a wind from 30 or from 45 deg, a time constant of 25 or of 40 min. With weights w_i from the
marginal likelihood of each shape in the residual of the model without the effect,

    mean = sum w_i theta_i,    variance = variance of the fit + sum w_i (theta_i - mean)^2

(Bayesian model averaging: Hoeting, Madigan, Raftery, Volinsky 1999). Likewise for a lag: a delay and a low-pass are as
likely as one another.
"""

from dataclasses import replace

import numpy as np

from estimator.diagnosis.averaged_residual import averages_of, weigh
from estimator.diagnosis.evidence import parameter_sd
from estimator.diagnosis.excess_lag import excess_lag
from estimator.diagnosis.lowpass import as_filtered
from estimator.diagnosis.model import Model, refit
from estimator.diagnosis.multi_drive import Drive
from estimator.diagnosis.thresholds import Thresholds
from estimator.model.design_matrix import Term
from estimator.signals import Floats, Quantity

MIN_SHAPE_WEIGHT = 0.01  # posterior weight of a shape that is fitted: the others change the mean too little
ROAD_LOAD = slice(0, 3)


def averaged(drive: Drive, thresholds: Thresholds) -> tuple[Floats, Floats]:
    """Mean and standard deviation of A [N], C [N s^2/m^2], m [kg] (3,)."""
    model = drive.model
    mean = model.road_load.copy()
    variance = np.array([parameter_sd(model.base, i) ** 2 for i in range(3)])
    for i, term in enumerate(model.terms):
        shapes = [shape for shape in term.effect.usable_shapes(drive.record.known) if not isinstance(shape, Quantity)]
        if term.spans is None and len(shapes) > 1:
            shift, spread = _over_shapes(
                model, i, [replace(term, shape=shape) for shape in shapes], thresholds.log_bf_temper
            )
            mean += shift
            variance += spread
    filtered = as_filtered(drive.record, model) if excess_lag(drive, thresholds) is not None else None
    if filtered is not None:
        half = (filtered.theta[ROAD_LOAD] - model.base.theta[ROAD_LOAD]) / 2
        mean += half
        variance += half**2
    return mean, np.sqrt(variance)


def _over_shapes(model: Model, i: int, variants: list[Term], temper: float) -> tuple[Floats, Floats]:
    """Shift (3,) and added variance (3,) of the road load [A, C, m] when the shape of term ``i`` is unknown."""
    others = (*model.terms[:i], *model.terms[i + 1 :])
    rest = refit(model, others)
    if rest is None:
        return np.zeros(3), np.zeros(3)
    _, ring = rest.views()
    averages, effect = averages_of(rest), model.terms[i].effect
    columns = averages.mean(np.column_stack([term.column(ring) for term in variants]))
    evidence = weigh(averages, columns, effect.usual(model.road_load), effect.positive).log_bayes_factor / temper
    weights = np.exp(evidence - evidence.max())
    weights /= weights.sum()
    likely = np.flatnonzero(weights > MIN_SHAPE_WEIGHT)
    fits = [refit(model, (*model.terms[:i], variants[k], *model.terms[i + 1 :])) for k in likely]
    theta = np.array([model.road_load if found is None else found.road_load for found in fits])
    share = weights[likely] / weights[likely].sum()
    mean = share @ theta
    return mean - model.road_load, share @ (theta - mean) ** 2

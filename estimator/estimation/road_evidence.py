"""Evidence of the road itself: whether there are hills, and whether the signals of the road show them."""

from dataclasses import replace

import numpy as np

from estimator.estimation.road_fit import RoadFit
from estimator.estimation.road_likelihood import ROAD_LOAD, Likelihood
from estimator.estimation.scale_search import most_probable
from estimator.model.road import ALPHAS, LEVEL
from estimator.strides import Strides


def log_bayes_factor_of_road(strides: Strides, found: RoadFit) -> float:
    """Of the road that was ``found`` under strides against a level one, the other scales found again without it."""
    return _log_evidence(strides, found, is_level=False) - _log_evidence(strides, found, is_level=True)


def log_bayes_factor_of_signals(strides: Strides, found: RoadFit) -> float:
    """Of one road that moves force and signals, against a road that moves the force and signals that show none.

    Where an unmodelled force is taken for a road, its signals do not follow.
    """
    blank = np.full(len(strides), np.nan)
    hidden = replace(strides, altitude=blank, grade=blank, gravity=blank)
    return log_bayes_factor_of_road(strides, found) - log_bayes_factor_of_road(hidden, found)


def _log_evidence(strides: Strides, found: RoadFit, is_level: bool) -> float:
    """Of strides with the orders, effects and lag that were found; the scales are found again."""
    sloping = ALPHAS[0] if found.scales.alpha == LEVEL else found.scales.alpha
    scales = replace(found.scales, alpha=LEVEL if is_level else sloping)
    model = scales.model_of(strides)
    terms = [term for term in found.terms if not (is_level and term.effect.is_gravity)]  # stretches of the road
    likelihood = Likelihood(model, terms, found.theta[:ROAD_LOAD], scales.lag)
    start = scales.values[: len(model.scales)]  # those of signals come last
    free = [i for i in scales.free if i < len(start)]
    values, _ = most_probable(likelihood, start, free)
    return likelihood.log_evidence(values)

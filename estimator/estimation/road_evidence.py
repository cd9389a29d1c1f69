"""Evidence of the road itself: whether there are hills, and whether the signals of the road show them."""

from dataclasses import replace

import numpy as np

from estimator.estimation.road_fit import RoadFit
from estimator.estimation.road_likelihood import Likelihood
from estimator.estimation.road_search import RoadScales
from estimator.estimation.scale_search import most_probable
from estimator.model.road import ALPHAS, LEVEL
from estimator.strides import Strides


def log_bayes_factor_of_road(strides: Strides, found: RoadFit, sloping: RoadScales | None = None) -> float:
    """Of the road that was ``found`` under strides against a level one, the other scales found again without it.

    A road that was found to be level gets slopes; ``sloping`` are scales of the strides with slopes. Noise that was
    found on a level road may hold the slopes, and none are found from there alone.
    """
    starts = [found.scales, *([] if sloping is None else [sloping])]
    hills = max(_log_evidence(strides, found, start, is_level=False) for start in starts)
    return hills - _log_evidence(strides, found, found.scales, is_level=True)


def log_bayes_factor_of_signals(strides: Strides, found: RoadFit) -> float:
    """Of one road that moves force and signals, against a road that moves the force and signals that show none.

    Where an unmodelled force is taken for a road, its signals do not follow.
    """
    blank = np.full(len(strides), np.nan)
    hidden = replace(strides, altitude=blank, grade=blank, gravity=blank)
    return log_bayes_factor_of_road(strides, found) - log_bayes_factor_of_road(hidden, found)


def _log_evidence(strides: Strides, found: RoadFit, start: RoadScales, is_level: bool) -> float:
    """Of strides with the effects that were found; the scales are found again from ``start``, with its orders."""
    sloping = ALPHAS[0] if start.alpha == LEVEL else start.alpha
    scales = replace(start, alpha=LEVEL if is_level else sloping)
    model = scales.model_of(strides)
    terms = [term for term in found.terms if not (is_level and term.effect.is_gravity)]  # stretches of the road
    likelihood = Likelihood(model, terms, found.road_load, scales.lag, taken=found.taken)
    first = scales.values[: len(model.scales)]  # those of signals come last
    free = [i for i in scales.free if i < len(first)]
    values, _ = most_probable(likelihood, first, free)
    return likelihood.log_evidence(values) - scales.price

"""Bayes factors for the road: hills against a level road, and one road common to the force and the signals of it."""

from dataclasses import replace

import numpy as np

from estimator.estimation.road_fit import RoadFit
from estimator.estimation.road_likelihood import Likelihood
from estimator.estimation.road_search import RoadScales
from estimator.estimation.scale_search import most_probable
from estimator.model.road import ALPHAS, LEVEL
from estimator.strides import Strides


def log_bayes_factor_of_road(strides: Strides, found: RoadFit, sloping: RoadScales | None = None) -> float:
    """Log Bayes factor of a road with slopes against a level road; scales are refitted under each hypothesis.

    If the fit ``found`` has a level road, its road gets slopes. ``sloping`` are further scales to start from: noise
    scales of a level road may include the slopes, and a search from them alone then finds none.
    """
    starts = [found.scales, *([] if sloping is None else [sloping])]
    hills = max(_log_evidence(strides, found, start, is_level=False) for start in starts)
    return hills - _log_evidence(strides, found, found.scales, is_level=True)


def log_bayes_factor_of_signals(strides: Strides, found: RoadFit) -> float:
    """Log Bayes factor of one road in force and signals, against a road in the force that the signals do not show.

    If the road of the fit is an unmodelled force, the signals are not correlated with it.
    """
    blank = np.full(len(strides), np.nan)
    hidden = replace(strides, altitude=blank, grade=blank, gravity=blank)
    return log_bayes_factor_of_road(strides, found) - log_bayes_factor_of_road(hidden, found)


def _log_evidence(strides: Strides, found: RoadFit, start: RoadScales, is_level: bool) -> float:
    """Log evidence of strides with the terms of the fit; scales are refitted from ``start`` at its orders."""
    sloping = ALPHAS[0] if start.alpha == LEVEL else start.alpha
    scales = replace(start, alpha=LEVEL if is_level else sloping)
    model = scales.model_of(strides)
    terms = [term for term in found.terms if not (is_level and term.effect.is_gravity)]  # stretches
    likelihood = Likelihood(model, terms, found.road_load, scales.lag, taken=found.taken)
    first = scales.values[: len(model.scales)]  # scales of signals come last
    free = [i for i in scales.free if i < len(first)]
    values, _ = most_probable(likelihood, first, free)
    return likelihood.log_evidence(values) - scales.price

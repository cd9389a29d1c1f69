"""Bayes factors for the road: hills against a level road, and one road common to the force and the signals of it."""

from collections.abc import Sequence
from dataclasses import replace
from operator import itemgetter

from estimator.estimation.road_fit import RoadFit
from estimator.estimation.road_likelihood import Likelihood
from estimator.estimation.scale_search import most_probable
from estimator.estimation.scales import RoadScales
from estimator.model.road import ALPHAS, LEVEL
from estimator.model.road_nodes import SIGNALS
from estimator.signals import Floats
from estimator.strides import Strides


def log_bayes_factor_of_road(strides: Strides, found: RoadFit, starts: Sequence[RoadScales] = ()) -> float:
    """Log Bayes factor of a road with slopes against a level road; scales are refitted under each hypothesis.

    If the fit ``found`` has a level road, its road gets slopes. Of its scales and ``starts``, a search begins with the
    most probable ones: noise scales of a level road may include the slopes, and a search from them then finds none.
    """
    known = [found.scales, *starts]
    return _log_evidence(strides, found, known, is_level=False) - _log_evidence(strides, found, known, is_level=True)


def log_bayes_factor_of_signals(strides: Strides, found: RoadFit, starts: Sequence[RoadScales] = ()) -> float:
    """Log Bayes factor of one road in force and signals, against a road in the force that the signals do not show.

    If the road of the fit is an unmodelled force, the signals are not correlated with it. ``starts``: as for
    `log_bayes_factor_of_road`.
    """
    shown, unseen = (log_bayes_factor_of_road(seen, found, starts) for seen in (strides, strides.without(SIGNALS)))
    return shown - unseen


def _log_evidence(strides: Strides, found: RoadFit, starts: Sequence[RoadScales], is_level: bool) -> float:
    """Log evidence of strides with the terms of the fit; scales are refitted from the best of ``starts``."""
    candidates = [_start(strides, found, start, is_level) for start in starts]
    likelihood, scales, first, _ = max(candidates, key=itemgetter(-1))
    values, _ = most_probable(likelihood, first, [i for i in scales.free if i < len(first)])
    return likelihood.log_evidence(values) - scales.price


def _start(
    strides: Strides, found: RoadFit, start: RoadScales, is_level: bool
) -> tuple[Likelihood, RoadScales, Floats, float]:
    """Likelihood of strides with the terms of the fit, with the orders and scales of ``start``, and its log evidence.

    The road is level or gets slopes.
    """
    sloping = ALPHAS[0] if start.alpha == LEVEL else start.alpha
    scales = replace(start, alpha=LEVEL if is_level else sloping)
    model = scales.model_of(strides)
    terms = [term for term in found.terms if not (is_level and term.effect.is_gravity)]  # stretches
    likelihood = Likelihood(model, terms, found.road_load, scales.lag, taken=found.taken)
    first = scales.values[: len(model.scales)]  # scales of signals come last
    return likelihood, scales, first, likelihood.log_evidence(first) - scales.price

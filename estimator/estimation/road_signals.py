"""Signals of the road that the force and the other signals contradict.

An altitude by satellite is smoothed, so it hardly shows hills of hundreds of metres. The model of an altimeter has
noise and a wander, but no smoothing: by its many even readings it makes the road level, against an accelerometer and
the force. So each signal is compared with all others. With D its readings and O those of the others:

    log p(motion, O | one road) + log p(D | no road) - log p(motion, O, D | one road)

The others must be sure of their road themselves:

    log p(motion, O | one road) - log p(motion | hidden road) - log p(O | no road)

By the force and a single signal it cannot be told which of the two is wrong: a force without a name varies, too. So it
stays in the fit, which gives it large errors. If it falls where the road of the fit climbs, it does not show that road.

A signal that never changes shows nothing: a sender repeats one value. Taken for a level road, it moved C to 2.7 times
its value. A road that is as level as that is found level without it.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from estimator.estimation.road_fit import RoadFit
from estimator.estimation.road_likelihood import Likelihood
from estimator.estimation.road_search import Search
from estimator.estimation.scale_search import most_probable
from estimator.estimation.scales import RoadScales
from estimator.model.road import LEVEL, ROUGH, SMOOTH
from estimator.model.road_nodes import SIGNALS
from estimator.model.road_scales import SCALES, SIGNAL_SCALES
from estimator.signals import Floats
from estimator.strides import Strides

MIN_LOG_BF = 8.0  # of both, as for a place where the vehicle turns; 27 of 27 trips of the BMW i3 exceed them

SearchOf = Callable[[Strides], Search | None]


def shown_by(strides: Strides) -> list[str]:
    """Names of the signals that show something of the road: they change."""
    return [name for name, readings in _readings(strides) if np.ptp(readings) > 0]


def constant(strides: Strides) -> tuple[str, ...]:
    """Names of the signals of the road that never change."""
    return tuple(name for name, readings in _readings(strides) if np.ptp(readings) == 0)


def _readings(strides: Strides) -> list[tuple[str, Floats]]:
    """Name and known readings of each signal of the road that has any."""
    readings = ((name, getattr(strides, name)) for name in SIGNALS)
    known = [(name, values[np.isfinite(values)]) for name, values in readings]
    return [(name, values) for name, values in known if len(values)]


def reversed_in(found: RoadFit) -> tuple[str, ...]:
    """Names of the signals of slope in a fit that fall where its road climbs: their sign is wrong, or it is no road."""
    falling = list[str]()
    for name in ("grade", "gravity"):  # those in proportion to the slope
        values = getattr(found.strides, name)
        known = np.isfinite(values)
        if known.any() and np.sum((values[known] - values[known].mean()) * found.slope[known]) < 0:
            falling.append(name)
    return tuple(falling)


def contradicted(strides: Strides, search_of: SearchOf) -> tuple[str, ...]:
    """Signals of the road that the force and the others contradict, the most contradicted one first.

    ``search_of`` makes the search over strides, which have no `constant` signals. One signal is always left.
    """
    left_out = tuple[str, ...]()
    while name := _most_contradicted(strides.without(left_out), search_of):
        left_out = *left_out, name
    return left_out


def _most_contradicted(strides: Strides, search_of: SearchOf) -> str:
    """Name of the signal that is most contradicted; empty where none is, or there is only one."""
    names = shown_by(strides)
    if len(names) < 2 or search_of(strides) is None:
        return ""

    usual = [scale.centre for scale in SCALES]  # noise of the power is in all of these models

    def on_one_road(without: list[str], worth: float = -np.inf) -> tuple[Likelihood, Floats, float]:
        """Likelihood, most probable scales and log evidence, where that is above ``worth``."""
        search = search_of(strides.without(without))
        assert search is not None  # signals of the road are not what it takes
        centre = search.central(level=False)
        start = replace(centre, values=np.append(usual, centre.values[len(SCALES) :]))
        likelihood = search.likelihood(start)
        return likelihood, *most_probable(likelihood, start.values, start.free, worth)

    likelihood, scales, hidden = on_one_road(names)
    alone = {name: _alone(strides, name, likelihood, scales) for name in names}
    apart = {"": -np.inf}  # log evidence of each signal apart from the others, where these confirm the force
    for name in names:
        least = hidden + sum(alone[other] for other in names if other != name) + MIN_LOG_BF
        others = on_one_road([name], least)[2]
        if others > least:
            apart[name] = others + alone[name]
    most = max(apart, key=lambda name: apart[name])
    worth = apart[most] - MIN_LOG_BF
    return most if most and on_one_road([], worth)[2] < worth else ""


def _alone(strides: Strides, name: str, hidden: Likelihood, scales: Floats) -> float:
    """Log evidence of the readings of one signal as noise and wander, on a road that they do not show.

    On a level road nothing links them to the motion, so the ``scales`` (k,) of a fit to that alone cancel.
    """
    start = np.append(scales[: len(SCALES)], [scale.centre for scale in SIGNAL_SCALES[name]])
    level = RoadScales(values=start, alpha=LEVEL, wander=ROUGH, readings=(name,), lag=hidden.lag, point=None)

    def likelihood(scales: RoadScales, shown: Strides) -> Likelihood:
        return Likelihood(scales.model_of(shown), (), hidden.road_load, hidden.lag)

    seen, own = strides.without([other for other in SIGNALS if other != name]), range(len(SCALES), len(start))
    wanders = (replace(level, wander=wander) for wander in (ROUGH, SMOOTH))
    best = max(most_probable(likelihood(wander, seen), start, own)[1] for wander in wanders)
    return best - likelihood(level, strides.without(SIGNALS)).log_evidence(start[: len(SCALES)])

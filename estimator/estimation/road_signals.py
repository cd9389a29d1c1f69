"""Signals of the road that the force and the other signals contradict.

An altitude by satellite is smoothed, so it hardly shows hills of hundreds of metres. The model of an altimeter has
noise and a wander, but no smoothing: by its many even readings it makes the road level, against an accelerometer and
the force. So each signal is compared with all others. With D its readings and O those of the others:

    log p(motion, O | one road) + log p(D | no road) - log p(motion, O, D | one road)

The others must be sure of their road themselves:

    log p(motion, O | one road) - log p(motion | hidden road) - log p(O | no road)

By the force and a single signal it cannot be told which of the two is wrong: a force without a name varies, too.
"""

from collections.abc import Callable

import numpy as np

from estimator.estimation.road_fit import RoadFit
from estimator.model.road_nodes import SIGNALS
from estimator.strides import Strides

MIN_LOG_BF = 8.0  # of both, as for a place where the vehicle turns: five trips of the BMW i3 have 258 or more

Fitted = Callable[[Strides, bool], RoadFit | None]


def contradicted(strides: Strides, fitted: Fitted) -> tuple[str, ...]:
    """Signals of the road that the force and the others contradict, the most contradicted one first.

    ``fitted`` fits strides on a road, which is level if its second argument is true. One signal is always left.
    """
    found = tuple[str, ...]()
    while name := _most_contradicted(strides.without(found), fitted):
        found = *found, name
    return found


def _most_contradicted(strides: Strides, fitted: Fitted) -> str:
    """Name of the signal that is most contradicted; empty where none is, or there is only one."""
    names = [name for name in SIGNALS if np.count_nonzero(np.isfinite(getattr(strides, name))) > 1]
    if len(names) < 2:
        return ""

    def log_evidence(shown: list[str], is_level: bool = False) -> float:
        fit = fitted(strides.without([name for name in names if name not in shown]), is_level)
        return -np.inf if fit is None else fit.log_evidence

    together, hidden, level = log_evidence(names), log_evidence([]), log_evidence([], is_level=True)
    alone = {name: log_evidence([name], is_level=True) - level for name in names}
    gains = {"": MIN_LOG_BF}
    for name in names:
        others = [other for other in names if other != name]
        beside = log_evidence(others)
        if beside - hidden - sum(alone[other] for other in others) > MIN_LOG_BF:
            gains[name] = beside + alone[name] - together
    return max(gains, key=lambda name: gains[name])

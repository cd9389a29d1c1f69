"""Fits of a drive that grows, at given scales: each goes on from the past of the one before where it can."""

from contextlib import suppress
from typing import Any

import numpy as np

from estimator.checkpoint.validation import Count, State, read
from estimator.estimation.past import Past
from estimator.estimation.road_fit import RoadFit, search_of, solved
from estimator.estimation.scales import RoadScales
from estimator.model.linear_gaussian import NotPositiveDefiniteError
from estimator.strides import Strides


class Continued:
    """Fits under one load, without effects; keeps the past of the strides between two of them."""

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Keep no past: the next strides, their signals or their scales are others."""
        self._keep(None)

    def _keep(self, past: Past | None) -> None:
        self._past, self._length, self._until = past, 0, 0.0
        if past is not None:
            self._length, self._until = len(past.t), float(past.t[-1])

    def fit(self, strides: Strides, scales: RoadScales) -> RoadFit | None:
        """The fit of all strides, as `fit_given` has it; None where they have no past that fits to them."""
        with suppress(NotPositiveDefiniteError):
            past, length = self._past, self._length
            if past is None and 0 < length <= len(strides) and strides.t[length - 1] == self._until:  # after a restart
                past = past_of(strides[:length], scales)
            if past is None or not past.is_of(strides, scales):
                past = past_of(strides, scales)
            self._keep(past)
            return None if past is None else fit_behind(past, strides)
        return None

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads: how many strides the past has, from which it is made again."""
        return {"length": self._length, "until": self._until}

    def restore(self, state: State) -> None:
        """Take the state of another one; the strides and scales are to be those of then.

        Raises
        ------
        StateError
            The state is not one of continued fits.
        """
        self._past = None
        self._length, self._until = read(state, "length", Count), read(state, "until", float)


def past_of(strides: Strides, scales: RoadScales) -> Past | None:
    """Return the past that strides without effects have at ``scales``; None where they have none."""
    search = search_of(strides) if Past.is_possible(strides) else None
    if search is None or search.model(scales).reading_names != scales.readings:
        return None
    return Past.of(search.likelihood(scales), scales)


def fit_behind(past: Past, strides: Strides) -> RoadFit | None:
    """Fit strides from their past on; None where the two do not fit together."""
    likelihood = past.likelihood_behind(strides)
    if likelihood is None:
        return None
    equations = past.equations_behind(likelihood)
    return solved(likelihood, past.scales, np.nan, (), equations, past, strides[strides.known])

"""The road under the vehicle now, between two conclusions: the filter of the newest fit over the strides since.

A conclusion comes once a minute, of strides that were cut 20 s at a time. Here strides are cut from every batch of
rows, and the filter takes each as soon as its brakes and shifts are known, about 2 s after its end. From its middle on
the process of the slope tells how the road goes on, and how uncertain that is, up to the newest row and beyond.

The filter begins anew with each fit, whose scales are other ones: with the newest strides of the fit, and from the
height that the filter before had there.
"""

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimator.checkpoint.validation import State, array
from estimator.errors import StateError
from estimator.estimates import Slope
from estimator.estimation.road_filter import Belief, RoadFilter
from estimator.estimation.road_fit import RoadFit
from estimator.preparation.admission import margin_of
from estimator.preparation.past_speed import last_known
from estimator.preparation.striding import Strider
from estimator.samples import STEP, Rows
from estimator.settings import Admission
from estimator.signals import Floats, Quantity
from estimator.strides import DURATION, Strides

# Strides, 5 min. With all of a drive of 20 min before them the slope differs by 0.03 sd over an altimeter that wanders,
# and by nothing over a hidden road.
REPLAYED = 300
WINDOW_DELAY = 120.0  # s by which the window's newest stride may be older than those here
KEPT_ROWS = 100  # with their distance: a stride's middle is among them when it comes
MAX_AGE = 12.0  # s after the newest speed, up to which the vehicle is where that leads; 8.4 s in steady traffic
MAX_EARLY = 1.0  # s before it: time stamps jitter
SPEED_CHANGE = 0.5  # m/s^2, sd of the acceleration since the newest speed


@dataclass(frozen=True, kw_only=True)
class RoadAhead:
    """Prediction of the road from the newest row on.

    ``belief`` is that at the middle of a stride. The vehicle is ``metres`` further at time ``t`` [s], at ``speed``
    [m/s].
    """

    t: float
    speed: float
    metres: float
    belief: Belief
    is_shown: bool

    def at(self, t: float) -> Slope | None:
        """The road under the vehicle at message time ``t`` [s]; None where that is too long after the newest row."""
        age = t - self.t
        if not -MAX_EARLY <= age <= MAX_AGE:
            return None
        age = max(age, 0.0)
        here = self.belief.ahead(self.metres + self.speed * age)
        bend = (here.mean[1] ** 2 + here.covariance[1, 1]) * here.rate**2  # of the slope over a metre, squared
        astray = min(0.5 * SPEED_CHANGE * age**2, self.speed * age)  # [m]
        return Slope(
            t=t,
            sine=float(here.mean[0]),
            sd=float(np.sqrt(here.covariance[0, 0] + bend * astray**2)),
            height=float(here.mean[-1]) if self.is_shown else np.nan,
            height_sd=float(np.sqrt(here.covariance[-1, -1])) if self.is_shown else np.nan,
        )


class RoadNow:
    """Follows the road from rows and conclusions.

    Parameters
    ----------
    admission
        Which moments are known, as for the strides of the window.
    is_followed
        Whether somebody asks for the road; else nothing is done.
    """

    def __init__(self, admission: Admission, is_followed: bool) -> None:
        self._admission, self._is_followed = admission, is_followed
        self.forget()

    def forget(self) -> None:
        """Another drive follows."""
        self._strider: Strider | None = None
        self._start: float | None = None  # [s] of the drive
        self._waiting: list[Strides] = []  # not in the filter yet
        self._fit: tuple[RoadFit, Strides] | None = None  # not yet in the filter either, and its strides
        self._fitted = -np.inf  # [s] up to which strides are in the fit's
        self._filter: RoadFilter | None = None
        self._heights: Floats = np.zeros((0, 3))  # of the filter before: times, heights, their standard deviations
        self._halt()

    def _halt(self) -> None:
        """Discard the vehicle's place: rows follow that are not joined to those before."""
        self._is_at_gap = False
        self._t, self._travelled = np.zeros((2, 0))  # [s] and [m] (n,) of the newest rows
        self._speed, self._heard = 0.0, -np.inf  # [m/s], [s] of the newest speed
        self._middle: float | None = None  # [m] of the newest stride

    def feed(self, rows: Rows, wanted: frozenset[Quantity] | None) -> None:
        """Take the next rows, which follow without a gap; strides begin when their ``wanted`` context is known."""
        self._start = float(rows.t[0]) if self._start is None else self._start
        if wanted is None or not self._is_followed:
            return
        if self._is_at_gap:
            self._halt()
        if self._strider is None:
            self._strider = Strider(self._admission, wanted, self._start)
        self._move(rows)
        self._add(self._strider.feed(rows, Counter()))
        kept = KEPT_ROWS + margin_of(rows, self._admission)
        self._t, self._travelled = self._t[-kept:], self._travelled[-kept:]

    def finish(self) -> None:
        """Use the rows that wait, before a gap or at the end of a log; the place is kept until rows follow."""
        if self._strider is not None:
            self._add(self._strider.finish(Counter()))
            self._strider.pause()
        self._is_at_gap = True

    def conclude(self, fit: tuple[RoadFit, Strides] | None) -> None:
        """Take a new fit and its strides, None where there is no fit to use from now on."""
        self._settle()
        if self._filter is not None:
            self._heights = np.array(self._filter.heights)[-2 * REPLAYED :]
        self._filter, self._fit = None, fit if self._is_followed else None
        if fit is not None:
            self._fitted = float(fit[1].t[-1]) + DURATION / 2
            self._keep_after(self._fitted)

    def here(self) -> RoadAhead | None:
        """The road under the newest row and ahead of it; None without a fit, or without a stride since a gap."""
        self._settle()
        if self._filter is None or self._middle is None:
            return None
        return RoadAhead(
            t=self._heard,
            speed=self._speed,
            metres=float(self._travelled[-1]) - self._middle,
            belief=self._filter.belief(),
            is_shown=self._filter.is_shown,
        )

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads: the height alone, for the next conclusion brings the filter."""
        self._settle()
        heights = self._heights if self._filter is None else np.array(self._filter.heights)[-2 * REPLAYED :]
        return {"heights": heights}

    def restore(self, state: State) -> None:
        """Take the state of another one.

        Raises
        ------
        StateError
            The state is not that of a road.
        """
        self._heights = array(state, "heights", (-1, 3))
        if np.any(np.diff(self._heights[:, 0]) <= 0) or np.any(self._heights[:, 2] < 0):
            raise StateError("heights: times do not rise, or a standard deviation is negative")

    def _move(self, rows: Rows) -> None:
        speed = last_known(rows.plausible_speed, self._speed)
        before = float(self._travelled[-1]) if len(self._travelled) else 0.0
        self._t = np.concatenate([self._t, rows.t])
        self._travelled = np.concatenate([self._travelled, before + np.cumsum(speed) * STEP])
        self._speed = float(speed[-1])
        heard = np.flatnonzero(np.isfinite(rows.plausible_speed))
        if len(heard):
            self._heard = float(rows.t[heard[-1]])

    def _add(self, strides: Strides) -> None:
        """Take new strides; the filter will see them when it settles."""
        if not len(strides):
            return
        self._middle = float(np.interp(strides.t[-1], self._t, self._travelled))
        self._waiting.append(strides[strides.t > self._fitted])
        if self._fit is None and self._filter is None:
            self._keep_after(float(strides.t[-1]) - WINDOW_DELAY)

    def _keep_after(self, t: float) -> None:
        """Forget the waiting strides up to a time [s]."""
        self._waiting = [part[part.t > t] for part in self._waiting]
        self._waiting = [part for part in self._waiting if len(part)]

    def _settle(self) -> None:
        """Bring the filter up to the newest stride."""
        if self._fit is not None:
            fit, strides = self._fit
            begin = max(len(strides) - REPLAYED, 0) if len(self._heights) else 0
            self._filter, self._fit = RoadFilter(fit, strides, begin, self._height(float(strides.t[begin]))), None
        if self._filter is not None:
            for strides in self._waiting:
                self._filter.follow(strides)
            self._waiting = []

    def _height(self, t: float) -> tuple[float, float]:
        """Height since the start at a time [s] of the filter before, and its standard deviation [m]."""
        if not len(self._heights):
            return 0.0, 0.0
        times, heights, sds = self._heights.T
        return float(np.interp(t, times, heights)), float(np.interp(t, times, sds))

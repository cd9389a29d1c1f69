"""The road as a state: the likelihood of a drive's strides where the slopes are unknown or measured with noise.

Newton's second law over a stride, solved for the acceleration (the driver reacts to past speed, not to the slopes
ahead, so force and speed are predetermined while acceleration is not):

    a = F / m - A / m - (C / m) rho v^2 - g theta(s) + (e1 - e0) / T - (f0 + f1) / 2 + w

with F the engine's force at the wheels and the unknown

    theta(s)   sine of the slope over distance: a Matern process,
    e          errors of the speeds at both ends of the stride: white,
    f          error of the measured force over the mass: Ornstein-Uhlenbeck in time, in proportion to the gearing
               (what is measured is the engine's torque), with w its part that does not follow from both ends,
    w          and white accelerations that no signal shows (gusts, rough road).

Altitude, grade and an accelerometer are measurements of the same theta, each with noise of its own:

    altitude = h(s) + wander + white,  h' = theta;   grade, gravity / g = theta(s) + offset + wander + white

where the wander is rough (Ornstein-Uhlenbeck) or smooth (Matern 3/2) in time, as the signal's filter makes it.
The model is linear in (1/m, A/m, C/m), and the covariance of everything else does not depend on m; theta is known
only through its prior and these signals. All unknowns are ordered by time, so the precision is banded and one
evaluation of the likelihood costs O(n).
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from estimator.model.linear_gaussian import Factor, NotPositiveDefiniteError, Observations, Places, bandwidth
from estimator.model.matern import MaternField
from estimator.model.ornstein_uhlenbeck import Chain, mean_given_ends
from estimator.signals import Floats
from estimator.strides import DURATION, Strides
from estimator.units import STANDARD_GRAVITY

SPACING = 25.0  # m between nodes of the road: finer changes no estimate (12.5 m: below 0.05 % of mass)
# m without strides that nodes bridge; slopes beyond are independent. At the usual slope length of 400 m those so far
# apart are correlated by 1 %.
MAX_BRIDGE = 1500.0
ALPHAS = (2, 4)  # orders of the road's Matern process: smoothness 3/2 (crests and dips of roads) and 7/2
ROUGH, SMOOTH = 1, 2  # orders of a signal's wander: smoothness 1/2 and 3/2
MIN_PASSAGE = 0.2  # s from node to node: shorter than that of any vehicle (125 m/s)
# s from node to node over which a smooth wander goes on: the usual wander time. Linear elements are good up to there
# (correlation of the ends 0.45, exactly 0.48); over 300 s the standard deviation comes out 19 % too small.
MAX_PASSAGE = 60.0
HEIGHT_SD = 0.01  # m, of the height about the integral of the slope: numerically exact
START_HEIGHT_SD = 1000.0  # m, of the height at the beginning: unknown
_POINTS = np.array([0.1, 0.3, 0.5, 0.7, 0.9])  # of a stride, where the road is looked up
_SHARES = np.array([0.08, 0.25, 0.34, 0.25, 0.08])  # their weights in the stride's mean
SIGNALS = ("altitude", "grade", "gravity")


@dataclass(frozen=True, kw_only=True)
class Scale:
    """A scale of the noise or of the road: lognormal prior ``centre`` and ``spread`` of the logarithm, and bounds."""

    name: str
    centre: float
    spread: float
    low: float
    high: float


# Centres and spreads are those of ordinary roads and sensors; drives of an hour override them.
SCALES = (
    Scale(name="torque noise", centre=5e-3, spread=1.0, low=1e-4, high=1.0),  # m/s^2, at the median gearing
    Scale(name="torque noise time", centre=0.5, spread=0.5, low=0.05, high=5.0),  # s
    Scale(name="speed noise", centre=4e-3, spread=1.0, low=2e-4, high=0.2),  # m/s, of the mean over EDGE rows
    Scale(name="disturbance", centre=5e-4, spread=0.5, low=1e-4, high=0.2),  # m/s^2, of what no signal shows
    Scale(name="slope", centre=8e-3, spread=1.2, low=1e-4, high=0.08),  # sine
    Scale(name="slope length", centre=400.0, spread=0.6, low=60.0, high=3000.0),  # m
)
SIGNAL_SCALES = {
    "altitude": (
        Scale(name="altitude noise", centre=0.3, spread=1.0, low=0.02, high=50.0),  # m
        Scale(name="altitude wander", centre=2.0, spread=1.2, low=0.05, high=300.0),  # m
        Scale(name="altitude wander time", centre=60.0, spread=1.0, low=5.0, high=3000.0),  # s
    ),
    "grade": (
        Scale(name="grade noise", centre=5e-3, spread=1.2, low=1e-4, high=0.3),  # sine
        Scale(name="grade wander", centre=5e-3, spread=1.2, low=1e-4, high=0.3),  # sine
        Scale(name="grade wander time", centre=60.0, spread=1.0, low=5.0, high=3000.0),  # s
    ),
    "gravity": (
        Scale(name="gravity noise", centre=5e-3, spread=1.2, low=1e-4, high=0.3),  # sine
        Scale(name="gravity wander", centre=5e-3, spread=1.2, low=1e-4, high=0.3),  # sine
        Scale(name="gravity wander time", centre=60.0, spread=1.0, low=5.0, high=3000.0),  # s
    ),
}


@dataclass(frozen=True)
class Nodes:
    """Points of the road [m] (N,), ascending; ``joined`` to the one before; ``t`` [s] when they were passed."""

    s: Floats
    joined: NDArray[np.bool_]
    t: Floats

    @classmethod
    def under(cls, strides: Strides) -> "Nodes":
        """Nodes every SPACING around all ``strides``, gaps up to MAX_BRIDGE filled."""
        cells = np.unique(np.floor(np.concatenate([strides.s0, strides.s1]) / SPACING).astype(np.int64))
        steps = np.diff(cells)
        bridged = steps * SPACING <= MAX_BRIDGE
        extra = [np.arange(a + 1, b) for a, b in zip(cells[:-1][bridged], cells[1:][bridged], strict=True) if b > a + 1]
        points = np.unique(np.concatenate([cells, cells + 1, *extra]))
        s = points * SPACING
        along = np.concatenate([strides.s0, strides.s1[-1:]])
        times = np.concatenate([strides.t - DURATION / 2, strides.t[-1:] + DURATION / 2])
        joined = np.insert(np.diff(points) == 1, 0, False)
        least = MIN_PASSAGE * np.arange(len(s))
        return cls(s, joined, np.maximum.accumulate(np.interp(s, along, times) - least) + least)

    def between(self, s: Floats) -> tuple[NDArray[np.int64], Floats]:
        """For each distance ``s`` (n,) [m] the node at or before it (n,), and the share of the way to the next (n,)."""
        before = np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 2).astype(np.int64)
        return before, (s - self.s[before]) / (self.s[before + 1] - self.s[before])


@dataclass(frozen=True)
class Reading:
    """One signal of the road averaged over the strides near each node: values (k,) at ``nodes`` (k,)."""

    name: str
    nodes: NDArray[np.int64]
    values: Floats
    counts: Floats

    @classmethod
    def of(cls, name: str, strides: Strides, nodes: Nodes) -> "Reading | None":
        """The signal ``name`` of SIGNALS; None where it is missing or has fewer than two values."""
        values = getattr(strides, name)
        there = np.isfinite(values)
        if there.sum() < 2:
            return None
        values = values[there] / (STANDARD_GRAVITY if name == "gravity" else 1.0)
        before, share = nodes.between(0.5 * (strides.s0 + strides.s1)[there])
        nearest = before + (share > 0.5)
        count = np.bincount(nearest, minlength=len(nodes.s)).astype(float)
        total = np.bincount(nearest, values, len(nodes.s))
        heard = np.flatnonzero(count)
        return cls(name, heard, total[heard] / count[heard], count[heard])


class RoadModel:
    """The likelihood of strides given the scales of road and noise; linear in the vehicle's parameters.

    Parameters
    ----------
    strides
        Those of one or several drives, in order of time.
    alpha
        Order of the road's Matern process, of ALPHAS.
    wander
        Order of the wander of all signals of the road: ROUGH or SMOOTH.
    """

    def __init__(self, strides: Strides, alpha: int, wander: int = ROUGH) -> None:
        self.strides, self.alpha, self.wander = strides, alpha, wander
        self.driven = strides[strides.known]
        self.joined = strides.joined[strides.known]
        self.nodes = Nodes.under(strides)
        readings = [Reading.of(name, strides, self.nodes) for name in SIGNALS]
        self.readings = tuple(reading for reading in readings if reading is not None)
        self.scales = (*SCALES, *(scale for reading in self.readings for scale in SIGNAL_SCALES[reading.name]))
        self._place()
        self._observe()

    @property
    def reading_names(self) -> tuple[str, ...]:
        """Signals of the road that are there."""
        return tuple(reading.name for reading in self.readings)

    @property
    def has_altitude(self) -> bool:
        """Whether height is among the unknowns."""
        return any(reading.name == "altitude" for reading in self.readings)

    def _place(self) -> None:
        """Give every unknown its place in the order of time."""
        driven, nodes = self.driven, self.nodes
        begins = np.flatnonzero(~self.joined)
        # Ends of strides: each stride's begin where it is not joined, and each stride's end.
        ends_t = np.concatenate([driven.t[begins] - DURATION / 2, driven.t + DURATION / 2])
        order = np.argsort(ends_t, kind="stable")
        place_of = np.empty(len(order), dtype=np.int64)
        place_of[order] = np.arange(len(order))
        self._after = place_of[len(begins) :]
        self._before = self._after - 1
        self._ends_t = ends_t[order]
        linked = np.zeros(len(order) - 1, dtype=bool)
        linked[self._before] = True
        self._linked = linked
        groups = [self._ends_t, self._ends_t + 1e-7, nodes.t]
        groups += [nodes.t + 1e-7] if self.has_altitude else []
        groups += [nodes.t + 2e-7 for _ in self.readings]  # at every node: a signal's gaps must not widen the band
        times = np.concatenate(groups)
        order = np.argsort(times, kind="stable")
        rank = np.empty(len(order), dtype=np.int64)
        rank[order] = np.arange(len(order))
        cut = np.cumsum([len(group) for group in groups])[:-1]
        parts = iter(np.split(rank, cut))
        self._speed_error, self._force_error, self._slope = next(parts), next(parts), next(parts)
        self._height = next(parts) if self.has_altitude else np.empty(0, np.int64)
        self._wander = [next(parts) for _ in self.readings]
        self.size = len(order)

    def _observe(self) -> None:
        """Set up the linear maps from unknowns to data, and the bands of the priors."""
        driven, nodes = self.driven, self.nodes
        n = len(driven)
        before, share = nodes.between(driven.s0[:, None] + (driven.s1 - driven.s0)[:, None] * _POINTS)
        first = before.min(axis=1)
        width = int((before.max(axis=1) - first).max()) + 2
        hats = np.zeros((n, width))
        row = np.arange(n)[:, None]
        np.add.at(hats, (row, before - first[:, None]), (1 - share) * _SHARES)
        np.add.at(hats, (row, before + 1 - first[:, None]), share * _SHARES)
        touched = np.minimum(first[:, None] + np.arange(width), len(nodes.s) - 1)
        self.weight = driven.gearing / np.median(driven.gearing)
        ends = np.column_stack([self._before, self._after])
        places = np.hstack([self._speed_error[ends], self._force_error[ends], self._slope[touched]])
        halves = -0.5 * np.repeat(self.weight[:, None], 2, axis=1)
        weights = np.hstack([np.tile([-1 / DURATION, 1 / DURATION], (n, 1)), halves, -STANDARD_GRAVITY * hats])

        maps: list[tuple[NDArray[np.int64], Floats]] = [(places, weights)]
        if self.has_altitude:
            on = np.flatnonzero(nodes.joined)
            half = 0.5 * (nodes.s[on] - nodes.s[on - 1])
            link = np.column_stack([self._height[on - 1], self._height[on], self._slope[on - 1], self._slope[on]])
            maps.append((link, np.column_stack([-np.ones_like(half), np.ones_like(half), -half, -half])))
            start = np.flatnonzero(~nodes.joined)
            maps.append((self._height[start][:, None], np.ones((len(start), 1))))
        for reading, wander in zip(self.readings, self._wander, strict=True):
            shown = self._height if reading.name == "altitude" else self._slope
            heard = np.column_stack([shown[reading.nodes], wander[reading.nodes]])
            maps.append((heard, np.ones(heard.shape)))
        slopes = [_reach(self._slope, k) for k in range(1, self.alpha + 1)]
        chains = [_reach(places, k) for places in self._wander for k in range(1, self.wander + 1)]
        noise = int(np.diff(self._force_error).max(where=self._linked, initial=0))
        shape = (max([*(bandwidth(p) for p, _ in maps), *slopes, *chains, noise]) + 1, self.size)
        self._maps = [Observations(p, w, shape) for p, w in maps]
        self._shape = shape
        # Height's links and starts have known variances: their part of the precision is always the same.
        self._is_fixed = [False, *([True, True] if self.has_altitude else []), *([False] * len(self.readings))]
        self._fixed = np.zeros(shape)
        if self.has_altitude:
            self._fixed += self._maps[1].information(np.full(len(maps[1][0]), HEIGHT_SD**2))
            self._fixed += self._maps[2].information(np.full(len(maps[2][0]), START_HEIGHT_SD**2))
        self._field = MaternField(nodes.s, nodes.joined, self.alpha, self._slope, shape)
        self._noise = Chain(self._ends_t, self._force_error, self._linked)
        self._wanders = [self._wandering(places) for places in self._wander]

    def _wandering(self, places: Places) -> Chain | MaternField:
        t = self.nodes.t
        if self.wander == ROUGH:
            return Chain(t, places, np.ones(len(t) - 1, dtype=bool))
        return MaternField(t, np.insert(np.diff(t) <= MAX_PASSAGE, 0, False), self.wander, places, self._shape)

    @cached_property
    def counts(self) -> tuple[int, ...]:
        """Number of observations of each kind: motion, height's links and starts, each reading."""
        joined = int(self.nodes.joined.sum())
        link = (joined, len(self.nodes.s) - joined) if self.has_altitude else ()
        return (len(self.driven), *link, *(len(reading.values) for reading in self.readings))

    def given(self, columns: Floats) -> Floats:
        """Data columns (sum of counts, c): the response's first, then those of the parameters.

        ``columns`` (n, c) belong to the motion of the n driven strides. Behind them come, in the first column the
        readings of the road, and in further columns of their own an offset for each that has one.
        """
        offsets = [reading for reading in self.readings if reading.name != "altitude"]
        data = np.zeros((sum(self.counts), columns.shape[1] + len(offsets)))
        data[: len(columns), : columns.shape[1]] = columns
        at = len(columns) + sum(self.counts[1 : -len(self.readings)] if self.readings else ())
        extra = columns.shape[1]
        for reading in self.readings:
            stop = at + len(reading.values)
            origin = reading.values[0] if reading.name == "altitude" else 0.0
            data[at:stop, 0] = reading.values - origin
            if reading.name != "altitude":
                data[at:stop, extra] = 1.0
                extra += 1
            at = stop
        return data

    def noise_of(self, scales: Floats) -> tuple[list[Floats], float, float]:
        """Variances of all observations, sd and correlation time [s] of the force's error, for ``scales`` (k,)."""
        torque, time, _, disturbance = scales[:4]
        weight, own = mean_given_ends(DURATION, time)
        variances = [torque**2 * own * self.weight**2 + disturbance**2]
        counts = list(self.counts[1:])
        if self.has_altitude:
            variances += [np.full(counts.pop(0), HEIGHT_SD**2), np.full(counts.pop(0), START_HEIGHT_SD**2)]
        for i, reading in enumerate(self.readings):
            variances.append(scales[len(SCALES) + 3 * i] ** 2 / np.minimum(reading.counts, 10.0))
        return variances, 2 * weight * torque, time

    def condition(self, scales: Floats) -> "Conditioned":
        """The model with its ``scales`` (k,), in the order of `scales`.

        Raises
        ------
        NotPositiveDefiniteError
            The scales lie too far apart for floating point.
        """
        variances, force, time = self.noise_of(scales)
        precision = self._fixed.copy()
        for observed, variance, fixed in zip(self._maps, variances, self._is_fixed, strict=True):
            if not fixed:
                precision += observed.information(variance)
        log_prior = -2 * len(self._speed_error) * np.log(scales[2])
        precision[0, self._speed_error] += scales[2] ** -2
        log_prior += self._noise.add_precision(precision, force, time)
        log_prior += self._field.add_precision(precision, scales[4], scales[5])
        for i, process in enumerate(self._wanders):
            log_prior += process.add_precision(precision, *scales[len(SCALES) + 3 * i + 1 : len(SCALES) + 3 * i + 3])
        factor = Factor.of(precision)
        log_noise = float(sum(np.log(variance).sum() for variance in variances))
        return Conditioned(self, np.concatenate(variances), factor, log_noise + factor.log_determinant - log_prior)

    def gathered(self, scaled: Floats) -> Floats:
        """A' times columns (sum of counts, c)."""
        parts = np.split(scaled, np.cumsum(self.counts)[:-1])
        total = np.zeros((self.size, scaled.shape[1]))
        for observed, part in zip(self._maps, parts, strict=True):
            total += observed.gathered(part)
        return total

    def observed(self, unknowns: Floats) -> Floats:
        """A times unknowns (size,)."""
        return np.concatenate([observed.observed(unknowns) for observed in self._maps])

    def road(self, unknowns: Floats) -> tuple[Floats, Floats]:
        """Slope at the nodes, and at the driven strides, of ``unknowns`` (size,)."""
        slope = unknowns[self._slope]
        return slope, self.slope_under(self.driven, unknowns)

    def slope_under(self, strides: Strides, unknowns: Floats) -> Floats:
        """Slope (n, ...) at the middle of strides on this road, of ``unknowns`` (size, ...)."""
        slope = unknowns[self._slope]
        before, share = self.nodes.between(0.5 * (strides.s0 + strides.s1))
        here: Floats = ((1 - share) * slope[before].T + share * slope[before + 1].T).T
        return here

    def sensor_errors(self, unknowns: Floats) -> Floats:
        """Acceleration [m/s^2] (n, ...) of the driven strides by errors of speed and force, but for the white part."""
        speed, force = unknowns[self._speed_error], unknowns[self._force_error]
        turned = (self.weight * (force[self._before] + force[self._after]).T).T
        errors: Floats = (speed[self._after] - speed[self._before]) / DURATION - 0.5 * turned
        return errors


def _reach(places: Places, step: int) -> int:
    """How far apart places ``step`` apart in (n,) are at most."""
    return int((places[step:] - places[:-step]).max()) if len(places) > step else 0


@dataclass(frozen=True)
class Conditioned:
    """A road model with given scales: K is the covariance of the data."""

    model: RoadModel
    variance: Floats
    factor: Factor = field(repr=False)
    log_determinant: float  # log|K|

    def gram(self, data: Floats) -> Floats:
        """Y' K^-1 Y (c, c) of data columns."""
        scaled = data / self.variance[:, None]
        whitened = self.factor.whiten(self.model.gathered(scaled))
        product: Floats = data.T @ scaled - whitened.T @ whitened
        return product

    def unknowns(self, residual: Floats) -> Floats:
        """Posterior mean (size,) of all unknowns, given the data less the parameters' part (sum of counts,)."""
        solved: Floats = self.factor.solve(self.model.gathered((residual / self.variance)[:, None]))[:, 0]
        return solved

    def weighed(self, residual: Floats) -> Floats:
        """K^-1 times a residual (sum of counts,)."""
        rest: Floats = (residual - self.model.observed(self.unknowns(residual))) / self.variance
        return rest

    def draws(self, residuals: Floats, rng: np.random.Generator) -> Floats:
        """Draws (size, d) of all unknowns from their posterior, one for each column of residuals (sum of counts, d)."""
        mean = self.factor.solve(self.model.gathered(residuals / self.variance[:, None]))
        return mean + self.factor.unwhiten(rng.standard_normal(mean.shape))


__all__ = ["ALPHAS", "Conditioned", "NotPositiveDefiniteError", "RoadModel", "Scale"]

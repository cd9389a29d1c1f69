"""The road as a state: likelihood of a drive's strides with slopes that are unknown, or measured with noise.

Newton's second law over a stride is solved for the acceleration. The driver reacts to past speed, not to the slopes
ahead, so force and speed are predetermined while acceleration is not:

    a = F / m - A / m - (C / m) rho v^2 - g theta(s) + (e1 - e0) / T - (f0 + f1) / 2 - (p0 + p1) / 2 + w

with F the engine's force at the wheels and the unknown

    theta(s)   sine of the slope over distance, in metres or warped by the speed: a Matern process,
    e          errors of the speeds at both ends of the stride: white,
    f          error of the measured force over the mass: Ornstein-Uhlenbeck in time, in proportion to the gearing
               (the measured quantity is the engine's torque),
    p          noise of the power over the mass (of the measured power, or of losses that vary): Ornstein-Uhlenbeck in
               time, over the speed,
    w          the parts of f and p that do not follow from both ends, and white accelerations that no signal shows
               (gusts, rough road).

Altitude, grade and an accelerometer are measurements of the same theta, each with noise of its own:

    altitude = h(s) + wander + white,  h' = theta;   grade, gravity / g = theta(s) + offset + wander + white

where the wander is rough (Ornstein-Uhlenbeck) or smooth (Matern 3/2) in time, depending on the signal's filter.
The model is linear in (1/m, A/m, C/m), and the covariance of everything else does not depend on m. Only its prior and
these signals determine theta. All unknowns are ordered by time, so the precision is banded and one evaluation of the
likelihood costs O(n). On a level road theta is 0, and nothing links the signals to the motion. The unknowns of the
signals then follow those of the motion, and the band is a quarter as wide.
"""

from collections.abc import Sequence
from copy import copy
from functools import cached_property
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from estimator.model.linear_gaussian import Factor, Observations, Places, bandwidth, dense
from estimator.model.matern import MaternField
from estimator.model.ornstein_uhlenbeck import Chain
from estimator.model.road_nodes import SIGNALS, Nodes, Place, Reading, References
from estimator.model.road_processes import Acting, ForceNoise
from estimator.model.road_scales import (
    DISTURBANCE,
    LENGTH,
    POWER,
    SCALES,
    SIGNAL_SCALES,
    SLOPE,
    SPEED,
    TORQUE,
    OperatingPoint,
)
from estimator.signals import Floats, Mask
from estimator.strides import DURATION, Strides
from estimator.units import STANDARD_GRAVITY

ALPHAS = (2, 4)  # orders of the road's Matern process: smoothness 3/2 (crests and dips of roads) and 7/2
LEVEL = 0  # in the place of an order: a road without slopes
ROUGH, SMOOTH = 1, 2  # orders of a signal's wander: smoothness 1/2 and 3/2
# s from node to node over which a smooth wander goes on: the usual wander time. Linear elements are good up to there
# (correlation of the ends 0.45, exactly 0.48); over 300 s the standard deviation comes out 19 % too small.
MAX_PASSAGE = 60.0
HEIGHT_SD = 0.01  # m, of the height about the integral of the slope: numerically exact
START_HEIGHT_SD = 1000.0  # m, of the height at the beginning: unknown
_POINTS = np.array([0.1, 0.3, 0.5, 0.7, 0.9])  # of a stride, where the road is looked up
_SHARES = np.array([0.08, 0.25, 0.34, 0.25, 0.08])  # their weights in the stride's mean


class RoadModel:
    """Likelihood of strides given the scales of road and noise; linear in the vehicle's parameters.

    Parameters
    ----------
    strides
        Strides of one or several drives, in order of time.
    alpha
        Order of the road's Matern process, of ALPHAS, or LEVEL.
    wander
        Order of the wander of all signals of the road: ROUGH or SMOOTH.
    power
        True if noise of the power is among the unknowns.
    designed
        True if the road is designed for the speed it is driven at: at lower speed, slopes change over less distance.
    turns
        Ranges of distance [m] in which the vehicle turns, and slopes change over less distance.
    point
        Point that scales of noise are given at; by default that of the strides.
    references
        Those of an earlier part of the drive, its point included; by default those of the strides.
    """

    def __init__(
        self,
        strides: Strides,
        alpha: int,
        wander: int = ROUGH,
        power: bool = True,
        designed: bool = False,
        turns: Sequence[Place] = (),
        point: OperatingPoint | None = None,
        references: References | None = None,
    ) -> None:
        self.strides, self.alpha, self.wander = strides, alpha, wander
        self.driven = driven = strides[strides.known]
        self.joined = strides.joined[strides.known]
        self.nodes = Nodes.under(strides)
        known = None if references is None else references.errors
        readings = [
            Reading.of(name, strides, self.nodes, None if known is None else known[name])
            for name in SIGNALS
            if known is None or name in known
        ]
        self.readings = tuple(reading for reading in readings if reading is not None)
        self.references = References.of(driven, self.readings, point) if references is None else references
        # Share of the errors of the torque and of the power in each stride's force.
        self.weight, of_power = self.references.point.shares(driven)
        self.force_noises = (ForceNoise(TORQUE, self.weight), ForceNoise(POWER, of_power))[: 1 + power]
        self.scales = (*SCALES, *(scale for reading in self.readings for scale in SIGNAL_SCALES[reading.name]))
        self._place()
        self._observe()
        self._lay(designed, turns)

    def laid(self, designed: bool, turns: Sequence[Place]) -> "RoadModel":
        """The model of the same strides on a road that is ``designed`` otherwise, with other ``turns``.

        All but the process of the slopes is shared with this one.
        """
        other = copy(self)
        other._lay(designed, turns)
        return other

    def _lay(self, designed: bool, turns: Sequence[Place]) -> None:
        """Set up the process of the slopes, over the distance [m] that they change with."""
        self.along, joined = self.nodes.along(designed, turns), self.nodes.joined
        self._field = None if self.is_level else MaternField(self.along, joined, self.alpha, self._slope, self._shape)

    @property
    def reading_names(self) -> tuple[str, ...]:
        """Names of the signals of the road that the drive has."""
        return tuple(reading.name for reading in self.readings)

    @property
    def is_level(self) -> bool:
        """True if the road has no slopes."""
        return self.alpha == LEVEL

    @property
    def has_altitude(self) -> bool:
        """True if height is among the unknowns."""
        return any(reading.name == "altitude" for reading in self.readings)

    def _place(self) -> None:
        """Assign each unknown its index, in order of time."""
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
        groups = [self._ends_t + 1e-7 * i for i in range(1 + len(self.force_noises))]
        node_t = nodes.t + (np.ptp(self._ends_t) + np.ptp(nodes.t) if self.is_level else 0.0)
        groups += [np.empty(0) if self.is_level else node_t]
        groups += [node_t + 1e-7] if self.has_altitude else []
        groups += [node_t + 2e-7 for _ in self.readings]  # at every node: a signal's gaps must not widen the band
        times = np.concatenate(groups)
        order = np.argsort(times, kind="stable")
        rank = np.empty(len(order), dtype=np.int64)
        rank[order] = np.arange(len(order))
        cut = np.cumsum([len(group) for group in groups])[:-1]
        parts = iter(np.split(rank, cut))
        self._speed_error, self._force_errors = next(parts), [next(parts) for _ in self.force_noises]
        self._slope = next(parts)
        self._height = next(parts) if self.has_altitude else np.empty(0, np.int64)
        self._wander = [next(parts) for _ in self.readings]
        self.size = len(order)
        self._times = times[order]
        self.kind_of = np.repeat(np.arange(len(groups), dtype=np.int8), [len(group) for group in groups])[order]

    def place_at(self, t: float) -> int:
        """Index of the first unknown at or after the time ``t`` [s]."""
        return int(np.searchsorted(self._times, t))

    def before(self, begin: int) -> list[Mask]:
        """Which observations of each kind depend on an unknown before the one with index ``begin``."""
        return [observed.before(begin) for observed in self._maps]

    def nodes_behind(self, begin: int) -> Mask:
        """Which nodes (N,) have slopes among the unknowns from ``begin`` on; all on a level road."""
        return np.ones(len(self.nodes.s), bool) if self.is_level else self._slope >= begin

    def information_of(self, these: Sequence[Mask], variance: Floats, begin: int, count: int) -> Floats:
        """Information (count, count) of ``these`` observations, of each kind, on the unknowns from ``begin`` on."""
        stored = np.zeros(self._shape)
        for (observed, rows), chosen in zip(self.kinds, these, strict=True):
            observed.add_information(stored, np.where(chosen, variance[rows], np.inf))
        return dense(stored[:, begin : begin + count])

    @cached_property
    def _motion(self) -> tuple[Places, Floats]:
        """Unknowns that the acceleration of each driven stride depends on (n, q), and their weights (n, q)."""
        places, weights = zip(self._errors(), self._slopes, strict=True)
        return np.hstack(places), np.hstack(weights)

    def _errors(self) -> tuple[Places, Floats]:
        """Errors of speed, torque and power among the unknowns of `_motion`, and their weights."""
        ends = np.column_stack([self._before, self._after])
        places = [error[ends] for error in (self._speed_error, *self._force_errors)]
        weights = [np.tile([-1 / DURATION, 1 / DURATION], (len(self.driven), 1))]
        weights += [-0.5 * np.repeat(noise.share[:, None], 2, axis=1) for noise in self.force_noises]
        return np.hstack(places), np.hstack(weights)

    @cached_property
    def _slopes(self) -> tuple[Places, Floats]:
        """Slopes among the unknowns of `_motion`, and their weights."""
        if self.is_level:
            return np.empty((len(self.driven), 0), np.int64), np.empty((len(self.driven), 0))
        touched, hats = self._slope_weights()
        return self._slope[touched], -STANDARD_GRAVITY * hats

    def _slope_weights(self) -> tuple[Places, Floats]:
        """Nodes near each driven stride (n, q), and their weights in its mean slope (n, q)."""
        driven, nodes = self.driven, self.nodes
        node, share = nodes.between(driven.s0[:, None] + (driven.s1 - driven.s0)[:, None] * _POINTS)
        first = node.min(axis=1)
        width = int((node.max(axis=1) - first).max()) + 2
        hats, row = np.zeros((len(driven), width)), np.arange(len(driven))[:, None]
        np.add.at(hats, (row, node - first[:, None]), (1 - share) * _SHARES)
        np.add.at(hats, (row, node + 1 - first[:, None]), share * _SHARES)
        return np.minimum(first[:, None] + np.arange(width), len(nodes.s) - 1), hats

    def _heights(self) -> list[tuple[Places, Floats]]:
        """Observations that link heights to slopes, and that start heights: unknowns and weights of each kind."""
        nodes, height = self.nodes, self._height
        on, start = np.flatnonzero(nodes.joined), np.flatnonzero(~nodes.joined)
        half = 0.5 * (nodes.s[on] - nodes.s[on - 1])[:, None]
        places, weights = [height[on - 1], height[on]], [-np.ones_like(half), np.ones_like(half)]
        if not self.is_level:
            places += [self._slope[on - 1], self._slope[on]]
            weights += [-half, -half]
        return [(np.column_stack(places), np.hstack(weights)), (height[start][:, None], np.ones((len(start), 1)))]

    def _measured(self, reading: Reading, wander: Places) -> tuple[Places, Floats]:
        """Unknowns that each reading of a signal shows, with weights: slope or height at its node, and its wander."""
        shown = self._height if reading.name == "altitude" else self._slope
        places = [*([shown[reading.nodes]] if len(shown) else []), wander[reading.nodes]]
        return np.column_stack(places), np.ones((len(reading.nodes), len(places)))

    def _observe(self) -> None:
        """Set up the linear maps from unknowns to data, and the bands of the priors."""
        maps = [self._motion, *(self._heights() if self.has_altitude else [])]
        maps += [self._measured(reading, wander) for reading, wander in zip(self.readings, self._wander, strict=True)]
        slopes = [_largest_distance(self._slope, k) for k in range(1, self.alpha + 1)]
        chains = [_largest_distance(places, k) for places in self._wander for k in range(1, self.wander + 1)]
        noise = [int(np.diff(error).max(where=self._linked, initial=0)) for error in self._force_errors]
        shape = (max([*(bandwidth(p) for p, _ in maps), *slopes, *chains, *noise]) + 1, self.size)
        self._maps = [Observations(p, w, shape) for p, w in maps]
        self._shape = shape
        self._speed_noise = Chain(self._ends_t, self._speed_error, np.zeros_like(self._linked))
        self._force_processes = [Chain(self._ends_t, error, self._linked) for error in self._force_errors]
        self._wanders = [self._wandering(places) for places in self._wander]

    def _wandering(self, places: Places) -> Chain | MaternField:
        t = self.nodes.t
        if self.wander == ROUGH:
            return Chain(t, places, np.ones(len(t) - 1, dtype=bool))
        return MaternField(t, np.insert(np.diff(t) <= MAX_PASSAGE, 0, False), self.wander, places, self._shape)

    @cached_property
    def counts(self) -> tuple[int, ...]:
        """Number of observations of each kind: motion, links and starts of heights, each signal of the road."""
        joined = int(self.nodes.joined.sum())
        link = (joined, len(self.nodes.s) - joined) if self.has_altitude else ()
        return (len(self.driven), *link, *(len(reading.values) for reading in self.readings))

    def given(self, columns: Floats) -> Floats:
        """Data columns (sum of counts, c + offsets): first that of the response, then those of the parameters.

        ``columns`` (n, c) belong to the motion of the n driven strides. In the rows behind them, the first column holds
        the readings of the road, and further columns the shapes of the offsets of each signal.
        """
        offsets = sum(reading.offsets.shape[1] for reading in self.readings)
        data = np.zeros((sum(self.counts), columns.shape[1] + offsets))
        data[: len(columns), : columns.shape[1]] = columns
        at = len(columns) + sum(self.counts[1 : -len(self.readings)] if self.readings else ())
        extra = columns.shape[1]
        for reading in self.readings:
            stop = at + len(reading.values)
            data[at:stop, 0] = reading.values - reading.errors.origin
            count = reading.offsets.shape[1]
            data[at:stop, extra : extra + count] = reading.offsets
            at, extra = stop, extra + count
        return data

    def acting(self, scales: Floats) -> tuple[Acting, ...]:
        """Processes among the unknowns, for ``scales`` (k,) in the order of `RoadModel.scales`."""
        speed, slope, length = scales[SPEED], scales[SLOPE], scales[LENGTH]
        unit = np.eye(len(scales))
        processes = [
            Acting(process=self._speed_noise, sd=speed, memory=1.0, by=np.array([unit[SPEED], 0 * unit[SPEED]])),
            *(n.acting(p, scales) for n, p in zip(self.force_noises, self._force_processes, strict=True)),
        ]
        if self._field is not None:
            processes.append(Acting(process=self._field, sd=slope, memory=length, by=unit[[SLOPE, LENGTH]]))
        for i, process in enumerate(self._wanders):
            at = len(SCALES) + 3 * i + 1
            processes.append(Acting(process=process, sd=scales[at], memory=scales[at + 1], by=unit[at : at + 2]))
        return tuple(processes)

    def noise_variance(self, scales: Floats) -> Floats:
        """Variance [m^2/s^4] (n,) of the mean f and p of each stride, given their values at both ends."""
        total: Floats = np.sum([noise.remaining(scales) for noise in self.force_noises], axis=0)
        return total

    def variances(self, scales: Floats) -> list[Floats]:
        """Variances of the observations of each kind, for ``scales`` (k,)."""
        variances = [scales[DISTURBANCE] ** 2 + self.noise_variance(scales)]
        counts = list(self.counts[1:])
        if self.has_altitude:
            variances += [np.full(counts.pop(0), HEIGHT_SD**2), np.full(counts.pop(0), START_HEIGHT_SD**2)]
        for i, reading in enumerate(self.readings):
            variances.append(scales[len(SCALES) + 3 * i] ** 2 / np.minimum(reading.counts, 10.0) + reading.bends)
        return variances

    def variances_by(self, scales: Floats) -> Floats:
        """Derivative (sum of counts, k) of the variances of all observations by the logarithms of the scales."""
        variances, ends = self.variances(scales), np.cumsum(self.counts)
        change = np.zeros((ends[-1], len(scales)))
        n = self.counts[0]
        for noise in self.force_noises:
            change[:n, noise.at : noise.at + 2] = noise.remaining_by(scales)
        change[:n, DISTURBANCE] = 2 * scales[DISTURBANCE] ** 2
        first = len(self.counts) - len(self.readings)
        for i, reading in enumerate(self.readings):
            rows = slice(ends[first + i - 1], ends[first + i])
            change[rows, len(SCALES) + 3 * i] = 2 * (variances[first + i] - reading.bends)
        return change

    def precision(self, scales: Floats, variances: Sequence[Floats]) -> tuple[Floats, float]:
        """Precision of all unknowns given the data, as a lower band, and log determinant of their prior precision.

        ``scales`` (k,) are those of the processes, ``variances`` those of the observations of each kind.
        """
        precision = np.zeros(self._shape)
        for observed, variance in zip(self._maps, variances, strict=True):
            observed.add_information(precision, variance)
        log_prior = sum(
            acting.process.add_precision(precision, acting.sd, acting.memory) for acting in self.acting(scales)
        )
        return precision, float(log_prior)

    def gathered(self, scaled: Floats) -> Floats:
        """A' times columns (sum of counts, c)."""
        total = np.zeros((self.size, scaled.shape[1]))
        for observed, rows in self.kinds:
            total += observed.gathered(scaled[rows])
        return total

    @cached_property
    def kinds(self) -> list[tuple[Observations, slice]]:
        """Linear map of each kind of observations, and its rows of data columns (sum of counts, c)."""
        ends = np.cumsum([0, *self.counts]).tolist()
        return [
            (observed, slice(start, end)) for observed, (start, end) in zip(self._maps, pairwise(ends), strict=True)
        ]

    def observed(self, unknowns: Floats) -> Floats:
        """A times unknowns (size,)."""
        return np.concatenate([observed.observed(unknowns) for observed in self._maps])

    def motion_variance(self, products: Floats) -> Floats:
        """Part (n,) of `variance` of the driven strides."""
        return self._maps[0].variance(products)

    def variance(self, products: Floats) -> Floats:
        """Variance (sum of counts,) of all observations by unknowns whose covariance is given as `both_triangles`."""
        return np.concatenate([observed.variance(products) for observed in self._maps])

    def road(self, unknowns: Floats) -> tuple[Floats, Floats]:
        """Slope (N, ...) at the nodes and (n, ...) at the driven strides, from ``unknowns`` (size, ...)."""
        slope = np.zeros((len(self.nodes.s), *unknowns.shape[1:])) if self.is_level else unknowns[self._slope]
        return slope, self.slope_under(self.driven, unknowns)

    def slope_under(self, strides: Strides, unknowns: Floats) -> Floats:
        """Slope (n, ...) at the middle of strides on this road, from ``unknowns`` (size, ...)."""
        if self.is_level:
            return np.zeros((len(strides), *unknowns.shape[1:]))
        slope = unknowns[self._slope]
        node, share = self.nodes.between(0.5 * (strides.s0 + strides.s1))
        here: Floats = ((1 - share) * slope[node].T + share * slope[node + 1].T).T
        return here

    def averages(self, strides: Strides, parts: NDArray[np.int64]) -> sp.csr_matrix:
        """Linear map (k, size) from unknowns to the mean slope of each of k parts of a road that is not level.

        ``parts`` (n,) is the number of the part of each stride, -1 for none; a stride is weighted by its length.
        """
        inside = np.flatnonzero(parts >= 0)
        part, length = parts[inside], (strides.s1 - strides.s0)[inside]
        weight = length / np.bincount(part, length)[part]
        node, share = self.nodes.between(0.5 * (strides.s0 + strides.s1)[inside])
        values = np.concatenate([(1 - share) * weight, share * weight])
        places = (np.tile(part, 2), np.concatenate([self._slope[node], self._slope[node + 1]]))
        return sp.csr_matrix((values, places), (int(part.max(initial=-1)) + 1, self.size))

    def slopes_before(self, scales: Floats) -> Factor:
        """Factor of the prior precision of the slopes of a road that is not level; other unknowns have precision 1."""
        assert self._field is not None
        precision = np.zeros(self._shape)
        precision[0] = 1.0
        precision[0, self._slope] = 0.0
        self._field.add_precision(precision, scales[SLOPE], scales[LENGTH])
        return Factor.of(precision)

    def shared_with_slopes(self, products: Floats) -> Floats:
        """Covariance [m^2/s^4] (n,) of the acceleration of each driven stride with its part by the slopes.

        ``products`` is the covariance of the unknowns, as `both_triangles`.
        """
        return self._shared(products, *self._slopes)

    def shared_with_torque(self, products: Floats) -> Floats:
        """Covariance as in `shared_with_slopes`, with the part by the noise of the torque at both ends."""
        ends = self._force_errors[0][np.column_stack([self._before, self._after])]
        return self._shared(products, ends, -0.5 * np.repeat(self.weight[:, None], 2, axis=1))

    def _shared(self, products: Floats, part: Places, part_weights: Floats) -> Floats:
        """Covariance (n,) of the acceleration of each driven stride with a sum of unknowns at ``part`` (n, q)."""
        places, weights = self._motion
        apart = places[:, :, None] - part[:, None, :]
        covariance = products[np.abs(apart), np.minimum(places[:, :, None], part[:, None, :])]
        covariance[apart != 0] /= 2
        shared: Floats = np.einsum("ni,nij,nj->n", weights, covariance, part_weights)
        return shared

    def slope_variance(self, products: Floats) -> Floats:
        """Variance (N,) [1] of the slope at each node; ``products`` as in `shared_with_slopes`."""
        variance: Floats = products[0, self._slope]
        return variance

    def sensor_errors(self, unknowns: Floats) -> Floats:
        """Acceleration [m/s^2] (n, ...) of the driven strides by e, f and p, without the white part w."""
        speed, turned = unknowns[self._speed_error], np.zeros((*unknowns.shape[1:], len(self.driven)))
        for at, noise in zip(self._force_errors, self.force_noises, strict=True):
            error = unknowns[at]
            turned += noise.share * (error[self._before] + error[self._after]).T
        errors: Floats = (speed[self._after] - speed[self._before]) / DURATION - 0.5 * turned.T
        return errors


def _largest_distance(places: Places, step: int) -> int:
    """Largest difference between elements of ``places`` (n,) that are ``step`` elements apart."""
    return int((places[step:] - places[:-step]).max()) if len(places) > step else 0

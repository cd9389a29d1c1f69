"""Nodes along the road of a drive, and the signals of the road averaged near each of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.model.road_scales import OperatingPoint
from estimator.samples import mean_density
from estimator.signals import Floats
from estimator.strides import DURATION, Strides
from estimator.units import STANDARD_GRAVITY

SPACING = 25.0  # m between nodes of the road: finer changes no estimate (12.5 m: below 0.05 % of mass)
# m without strides that nodes bridge; slopes beyond are independent. At the usual slope length of 400 m those so far
# apart are correlated by 1 %.
MAX_BRIDGE = 1500.0
MIN_PASSAGE = 0.2  # s from node to node: shorter than that of any vehicle (125 m/s)
SIGNALS = ("altitude", "grade", "gravity")
OFFSET_SD = 1.0  # sine, of the prior of the offset of a signal of slope: nothing is known of it
# m^2/s^2. In a bend at yaw rate r, an accelerometer l ahead of the rear axle measures the centripetal acceleration
# r^2 l = (v r)^2 l / v^2 besides: l is about 1 m, and (v r)^2 is 3 m^2/s^4 where junctions and straights follow each
# other. It is never negative, but is taken as noise of mean 0: the offset has its mean.
BEND = 3.0 / STANDARD_GRAVITY
# m/s. For the same change of slope a vertical curve is as long as the square of the speed that its road is designed
# for, by sight distance and comfort: below this one, slopes change the sooner the slower the road is driven.
DESIGN_SPEED = 20.0
SLOWEST = 5.0  # m/s: as slow as this, nodes are a usual slope length of 400 m apart, and their sd is 4 % off
# m/s. Where a vehicle turns round, or into another road, the slope along its way is another one. It does so slower than
# this: on the circle of 12.5 m that directive 97/27/EC lets it need, at 3 m/s^2 across.
TURNING_SPEED = 6.0

Place = tuple[float, float]  # from one distance [m] to another


def warping(speed: Floats) -> Floats:
    """Factor (n,) by which slopes change over less distance on a road designed for a ``speed`` [m/s] (n,)."""
    factor: Floats = 1 + (DESIGN_SPEED / np.maximum(speed, SLOWEST)) ** 2
    return factor


@dataclass(frozen=True)
class Nodes:
    """Nodes of the road at distances ``s`` (N,) [m], ascending, passed at the times ``t`` (N,) [s].

    ``joined`` (N,) is True where slopes continue from the node before. ``speed`` (N - 1,) [m/s] is that from each node
    to the next.
    """

    s: Floats
    joined: NDArray[np.bool_]
    t: Floats
    speed: Floats

    @classmethod
    def under(cls, strides: Strides) -> "Nodes":
        """Place nodes every SPACING along all ``strides``, and across gaps up to MAX_BRIDGE."""
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
        passed = np.maximum.accumulate(np.interp(s, along, times) - least) + least
        middle = np.maximum.accumulate(0.5 * (strides.s0 + strides.s1))
        speed = np.interp(0.5 * (s[1:] + s[:-1]), middle, (strides.s1 - strides.s0) / DURATION)
        return cls(s, joined, passed, speed)

    def along(self, designed: bool, turns: Sequence[Place]) -> Floats:
        """Warped distance (N,) [m] of the nodes, over which slopes change at one rate.

        It is stretched by `warping` where the road is ``designed`` for the speed that it is driven at. Within ``turns``
        it is stretched as on a road for SLOWEST.
        """
        factor = warping(self.speed) if designed else np.ones(len(self.speed))
        middle = 0.5 * (self.s[1:] + self.s[:-1])
        for begin, end in turns:
            factor[(middle > begin) & (middle < end)] = warping(np.array(SLOWEST))
        return np.cumsum(np.concatenate([self.s[:1], np.diff(self.s) * factor]))

    def slow_places(self) -> list[Place]:
        """Ranges of distance [m] driven below TURNING_SPEED, in which the vehicle may turn."""
        slow = np.concatenate([[False], self.joined[1:] & (self.speed < TURNING_SPEED), [False]])
        edges = self.s[np.flatnonzero(np.diff(slow))]
        return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))

    def between(self, s: Floats) -> tuple[NDArray[np.int64], Floats]:
        """Node at or before each distance ``s`` (n,) [m], and share (n,) of the interval to the next node."""
        node = np.clip(np.searchsorted(self.s, s, side="right") - 1, 0, len(self.s) - 2).astype(np.int64)
        return node, (s - self.s[node]) / (self.s[node + 1] - self.s[node])


@dataclass(frozen=True, kw_only=True)
class ErrorScale:
    """Scale of the readings of a signal and of their ``number`` of constant errors.

    ``offset_sd`` is the prior sd of each error. A signal of slope has one, a constant. Errors of a map come from the
    rolling resistance and the drag of earlier drives at about this speed. A map so has a second one, in proportion to
    the square of the speed over its mean ``mean_square`` [m^2/s^2]. Altitudes are relative to ``origin`` [m].
    """

    number: int
    offset_sd: float
    mean_square: float
    origin: float


@dataclass(frozen=True, kw_only=True)
class Reading:
    """Signal of the road averaged over the strides near each node: ``values`` (k,) at ``nodes`` (k,).

    ``bends`` (k,) is the variance that bends add to an accelerometer, ``offsets`` (k, c) are the shapes of its constant
    errors, of the size of its ``errors``.
    """

    name: str
    nodes: NDArray[np.int64]
    values: Floats
    counts: Floats
    bends: Floats
    offsets: Floats
    errors: ErrorScale

    @classmethod
    def of(cls, name: str, strides: Strides, nodes: Nodes, errors: ErrorScale | None = None) -> "Reading | None":
        """Average the signal ``name`` of SIGNALS, with errors of the scale of an earlier part of the drive or its own.

        Returns None if there are fewer than two values to find a scale from.
        """
        values = getattr(strides, name)
        there = np.isfinite(values)
        if errors is None and there.sum() < 2:
            return None
        values = values[there] / (STANDARD_GRAVITY if name == "gravity" else 1.0)
        node, share = nodes.between(0.5 * (strides.s0 + strides.s1)[there])
        nearest = node + (share > 0.5)
        count = np.bincount(nearest, minlength=len(nodes.s)).astype(float)
        total = np.bincount(nearest, values, len(nodes.s))
        heard = np.flatnonzero(count)
        squares = _means(strides.speed[there] ** 2, nearest, len(nodes.s))[heard]
        means = total[heard] / count[heard]
        if errors is None:
            offset_sds = strides.grade_offset_sd[there]
            is_map = name == "grade" and bool(np.isfinite(offset_sds).any())
            errors = ErrorScale(
                number=0 if name == "altitude" else 1 + is_map,
                offset_sd=float(np.sqrt(np.nanmean(offset_sds**2))) if is_map else OFFSET_SD,
                mean_square=float(squares.mean()),
                origin=float(means[0]) if name == "altitude" else 0.0,
            )
        return cls(
            name=name,
            nodes=heard,
            values=means,
            counts=count[heard],
            bends=(BEND / squares) ** 2 if name == "gravity" else np.zeros(len(heard)),
            offsets=np.column_stack([np.ones(len(heard)), squares / errors.mean_square])[:, : errors.number],
            errors=errors,
        )


@dataclass(frozen=True, kw_only=True)
class References:
    """References of a drive for its noise, its air and its signals.

    ``density`` [kg/m^3] is the mean, ``errors`` are those of each signal of the road.
    """

    point: OperatingPoint
    density: float
    errors: Mapping[str, ErrorScale]

    @classmethod
    def of(cls, driven: Strides, readings: Sequence[Reading], point: OperatingPoint | None) -> "References":
        """Those of the strides with a known force, and of the readings of a drive; by default its own ``point``."""
        return cls(
            point=OperatingPoint.of(driven) if point is None else point,
            density=mean_density(driven.density),
            errors={reading.name: reading.errors for reading in readings},
        )


def _means(values: Floats, places: NDArray[np.int64], number: int) -> Floats:
    """Mean (number,) of the known ``values`` (n,) at each of the ``places`` (n,); the overall mean if there is none."""
    is_known = np.isfinite(values)
    total, count = (np.bincount(places[is_known], weights, number) for weights in (values[is_known], None))
    means = np.full(number, total.sum() / max(int(count.sum()), 1))
    means[count > 0] = total[count > 0] / count[count > 0]
    return means

"""Find where model and vehicle disagree: the mean residual of the plain model in parts of each axis.

A mean is tested against the spread of sums over blocks of BLOCK seconds, because residuals are autocorrelated. The
false discovery rate over all parts of all axes is at most MAX_FALSE_DISCOVERY_RATE (Benjamini & Hochberg 1995).
"""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtr

from estimator.diagnosis.result import GapMap, Place, Traces
from estimator.false_discovery import false_discovery_rates
from estimator.signals import Floats, Quantity

PARTS = 8
MAX_FALSE_DISCOVERY_RATE = 0.05  # 1 in 20 of the listed places is expected to be false
BLOCK = 6.0  # s, over which residuals are summed before their spread is computed
MIN_ROWS = 10  # rows of 2 s in a part
MIN_BLOCKS = 8  # independent blocks of a part: with fewer, their variance is too uncertain for a test
SPEED_CELL, ACCELERATION_CELL = 2.5, 0.1  # m/s, m/s^2
MIN_CELL_ROWS = 2  # rows of 2 s in a cell of the map


def biased_parts(traces: Traces, context: Mapping[Quantity, Floats]) -> list[Place]:
    """Parts of axes where the mean residual is not zero, largest share first; ``context`` (n,): further axes."""
    residual, block = traces.measured - traces.base, _blocks(traces)
    total = float(residual @ residual)
    judged: list[tuple[str, str, float, float, float, float, float]] = []
    for name, unit, values, edges in _axes(traces, context):
        for start, end in pairwise(edges.tolist()):
            part = (values >= start) & (values < end)
            count = int(part.sum())
            if count < MIN_ROWS:
                continue
            sums, counts = (np.bincount(block, weights) for weights in (residual * part, part.astype(float)))
            used = counts > 0
            if used.sum() < MIN_BLOCKS:
                continue
            bias = float(sums.sum()) / count
            spread = float(np.sqrt(((sums - bias * counts) ** 2).sum()))
            p = 2 * float(stdtr(used.sum() - 1, -abs(sums.sum()) / max(spread, np.finfo(float).tiny)))  # Student
            judged.append((name, unit, start, end, bias, count * bias**2 / total, p))
    if not judged:
        return []
    q = false_discovery_rates(np.array([row[-1] for row in judged]))
    listed = [
        Place(axis=name, start=start, end=end, unit=unit, bias=bias, share=share, q_value=float(value))
        for (name, unit, start, end, bias, share, _), value in zip(judged, q, strict=True)
        if value < MAX_FALSE_DISCOVERY_RATE
    ]
    return sorted(listed, key=lambda place: -place.share)


def _blocks(traces: Traces) -> NDArray[np.int64]:
    """Number (n,) of the block of BLOCK seconds of each row; no block holds rows of two logs."""
    number = np.floor(traces.t / BLOCK) + traces.log * (np.floor(traces.t.max() / BLOCK) + 1)
    return np.unique(number, return_inverse=True)[1].astype(np.int64)


def _axes(traces: Traces, context: Mapping[Quantity, Floats]) -> list[tuple[str, str, Floats, Floats]]:
    """Name, unit, values (n,) and edges of the parts of each axis; time and distance only where time ascends."""
    power = traces.base / 1e3
    axes = [
        ("speed", "m/s", traces.speed, _quantiles(traces.speed)),
        ("acceleration", "m/s^2", traces.acceleration, _quantiles(traces.acceleration)),
        ("power", "kW", power, _quantiles(power)),
    ]
    if np.all(np.diff(traces.t) > 0):
        distance = traces.distance / 1e3
        axes += [("time", "s", traces.t, _equal(traces.t)), ("distance", "km", distance, _equal(distance))]
    if Quantity.GEAR in context:
        gear = np.round(context[Quantity.GEAR])
        axes.append(("gear", "", gear, np.arange(gear.min(), gear.max() + 2)))
    if Quantity.HEADING in context:
        heading = np.degrees(context[Quantity.HEADING]) % 360
        axes.append(("heading", "deg", heading, np.linspace(0, 360, PARTS + 1)))
    if Quantity.TEMPERATURE in context:
        temperature = context[Quantity.TEMPERATURE] - 273.15
        axes.append(("temperature", "degC", temperature, _equal(temperature)))
    return axes


def _quantiles(x: Floats) -> Floats:
    edges = np.unique(np.quantile(x, np.linspace(0, 1, PARTS + 1)))
    edges[-1] = np.nextafter(edges[-1], np.inf)
    return edges


def _equal(x: Floats) -> Floats:
    edges = np.linspace(float(x.min()), float(x.max()), PARTS + 1)
    edges[-1] = np.nextafter(edges[-1], np.inf)
    return edges


def gap_map(traces: Traces, extended: Floats) -> GapMap:
    """Mean residual [W] in cells of speed and acceleration: of the plain model, and of power ``extended`` [W] (n,)."""
    speed = np.arange(0.0, float(traces.speed.max()) + SPEED_CELL, SPEED_CELL)
    low, high = np.quantile(traces.acceleration, [0.001, 0.999])
    acceleration = np.arange(
        np.floor(low / ACCELERATION_CELL) * ACCELERATION_CELL, high + ACCELERATION_CELL, ACCELERATION_CELL
    )
    count = np.histogram2d(traces.speed, traces.acceleration, [speed, acceleration])[0]

    def mean(power: Floats) -> Floats:
        residual = traces.measured - power
        total = np.histogram2d(traces.speed, traces.acceleration, [speed, acceleration], weights=residual)[0]
        return np.where(count >= MIN_CELL_ROWS, total / np.maximum(count, 1), np.nan)

    return GapMap(
        speed_edges=speed,
        acceleration_edges=acceleration,
        plain=mean(traces.base),
        extended=mean(extended),
        samples=count,
    )

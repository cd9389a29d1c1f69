"""Where the model and the vehicle disagree: the residual by parts of each axis.

The mean of a part is judged against the long-run noise of its own stretches: residuals that stay on one side for
seconds count once. The rate of false discoveries over all parts of all axes is at most MAX_FALSE_DISCOVERY_RATE
(Benjamini & Hochberg 1995).
"""

from itertools import pairwise

import numpy as np
from scipy.special import stdtr

from estimator.diagnosis.base import block_sums
from estimator.diagnosis.model import Model
from estimator.diagnosis.result import GapMap, Place
from estimator.false_discovery import false_discovery_rates
from estimator.signals import Floats, Quantity

PARTS = 8
MAX_FALSE_DISCOVERY_RATE = 0.05  # usual; 1 in 20 of the places listed is expected to be false
MIN_SAMPLES = 200  # samples in a part
MIN_BLOCKS = 8  # independent blocks of a part: with fewer, their variance is too uncertain for a test
SPEED_CELL, ACCELERATION_CELL = 2.5, 0.1  # m/s, m/s^2
MIN_CELL_SAMPLES = 30  # 3 s, in a cell of the map


def places(model: Model) -> list[Place]:
    """Parts of all axes where the residual is not zero, largest share of it first."""
    residual, block = model.base.residual, model.base.block
    total = float(residual @ residual)
    found: list[tuple[str, str, float, float, float, float, float]] = []
    for name, unit, values, edges in _axes(model):
        for start, end in pairwise(edges):
            part = (values >= start) & (values < end)
            if part.sum() < MIN_SAMPLES:
                continue
            sums = block_sums((residual * part)[:, None], block)[:, 0]
            used = sums[sums != 0]
            if len(used) < MIN_BLOCKS:
                continue
            count = int(part.sum())
            bias = float(sums.sum()) / count
            each = block_sums(part.astype(float)[:, None], block)[:, 0]
            spread = float(np.sqrt(((sums - bias * each) ** 2).sum()))
            p = 2 * float(stdtr(len(used) - 1, -abs(sums.sum()) / spread))  # Student
            found.append((name, unit, float(start), float(end), bias, count * bias**2 / total, p))
    if not found:
        return []
    q = false_discovery_rates(np.array([row[-1] for row in found]))
    chosen = [
        Place(axis=name, start=start, end=end, unit=unit, bias=bias, share=share, q_value=float(value))
        for (name, unit, start, end, bias, share, _), value in zip(found, q, strict=True)
        if value < MAX_FALSE_DISCOVERY_RATE
    ]
    return sorted(chosen, key=lambda place: -place.share)


def _axes(model: Model) -> list[tuple[str, str, Floats, Floats]]:
    """Name, unit, value of each sample and edges of the parts."""
    s = model.samples
    context = s.context
    power = model.base.Z @ model.base.theta
    axes = [
        ("speed", "m/s", s.zv, _quantiles(s.zv)),
        ("acceleration", "m/s^2", s.za, _quantiles(s.za)),
        ("power", "kW", power / 1e3, _quantiles(power / 1e3)),
    ]
    elapsed = s.t - s.t[0]
    axes.append(("time", "s", elapsed, _equal(elapsed)))
    if Quantity.DISTANCE in context:
        distance = context[Quantity.DISTANCE] / 1e3
        axes.append(("distance", "km", distance, _equal(distance)))
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


def gap_map(before: Model, after: Model) -> GapMap:
    """Mean residual in cells of speed and acceleration, of the plain and of the extended model."""
    s = before.samples
    speed = np.arange(0.0, float(s.zv.max()) + SPEED_CELL, SPEED_CELL)
    low, high = np.quantile(s.za, [0.001, 0.999])
    acceleration = np.arange(
        np.floor(low / ACCELERATION_CELL) * ACCELERATION_CELL, high + ACCELERATION_CELL, ACCELERATION_CELL
    )
    bins = [speed, acceleration]

    def mean(model: Model) -> tuple[Floats, Floats]:
        samples = model.samples
        count = np.histogram2d(samples.zv, samples.za, bins)[0]
        total = np.histogram2d(samples.zv, samples.za, bins, weights=model.base.residual)[0]
        return np.where(count >= MIN_CELL_SAMPLES, total / np.maximum(count, 1), np.nan), count

    (first, count), (second, _) = mean(before), mean(after)
    return GapMap(speed_edges=speed, acceleration_edges=acceleration, before=first, after=second, samples=count)

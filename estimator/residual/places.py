"""Find the parts of each axis where the mean residual is not zero, with one false discovery rate over all parts."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from estimator.false_discovery import false_discovery_rates
from estimator.residual.answer import Disagreement
from estimator.residual.inputs import Record
from estimator.residual.terms import ResidualLikelihood
from estimator.signals import Floats

PARTS = 8  # of an axis, with equal numbers of samples; one for each value if there are at most as many
MAX_FALSE_DISCOVERY_RATE = 0.05  # Benjamini & Hochberg 1995: 1 in 20 of the listed places is expected to be false
MIN_SHARE = 0.01  # of the samples that a part has to hold


def disagreements(record: Record, likelihood: ResidualLikelihood) -> tuple[Disagreement, ...]:
    """Parts whose mean residual is significant under the likelihood's noise, after the base; smallest q-value first."""
    parts, indicators = [], []
    for name, axis in record.axes.items():
        for start, end, inside in _parts(axis.values):
            if MIN_SHARE < inside.mean() < 1:
                parts.append((name, start, end, axis.unit))
                indicators.append(inside.astype(float))
    if not parts:
        return ()
    products, score = likelihood.projected([], np.column_stack(indicators))
    strength = np.maximum(np.diag(products), 1e-300)
    bias = score / strength
    q_values = false_discovery_rates(2 * ndtr(-np.abs(score) / np.sqrt(strength)))
    listed = [
        Disagreement(axis=name, start=start, end=end, unit=unit, bias=float(b), q_value=float(q))
        for (name, start, end, unit), b, q in zip(parts, bias, q_values, strict=True)
        if q < MAX_FALSE_DISCOVERY_RATE
    ]
    return tuple(sorted(listed, key=lambda part: part.q_value))


def _parts(values: Floats) -> Iterator[tuple[float, float, NDArray[np.bool_]]]:
    """Start, end and mask (n,) of each part; an axis with at most PARTS values (a switch) has one for each value."""
    distinct = np.unique(values)
    if len(distinct) <= PARTS:
        yield from ((value, value, values == value) for value in distinct.tolist())
        return
    edges = np.unique(np.quantile(values, np.linspace(0, 1, PARTS + 1)))
    for start, end in pairwise(edges.tolist()):
        yield start, end, (values >= start) & ((values < end) | (end == edges[-1]))

"""Rates of false discoveries among many comparisons."""

import numpy as np

from estimator.signals import Floats


def false_discovery_rates(p: Floats) -> Floats:
    """The smallest rates at which each of the p-values (n,) is a discovery (Benjamini & Hochberg 1995)."""
    p = np.clip(p, 0.0, 1.0)  # rounding
    order, rates = np.argsort(-p), np.empty_like(p)
    rates[order] = np.minimum.accumulate(p[order] * len(p) / np.arange(len(p), 0, -1))
    return rates

"""Spans: sets of times in which an effect or a process acts, and operations on them."""

from itertools import pairwise

import numpy as np

from estimator.signals import Floats

Span = tuple[float, float]  # from and to [s]
Spans = tuple[Span, ...]  # ascending, none overlapping


def inside(t: Floats, spans: Spans) -> Floats:
    """1 for each time [s] (n,) within one of the spans, 0 elsewhere."""
    edges = np.array(spans).reshape(-1, 2)
    begun, ended = np.searchsorted(edges[:, 0], t, side="right"), np.searchsorted(edges[:, 1], t, side="left")
    within: Floats = (begun > ended).astype(float)
    return within


def covered(t: Floats, duration: float | Floats, spans: Spans) -> Floats:
    """Share (n,) within ``spans`` of the intervals of ``duration`` [s], scalar or (n,), centred at ``t`` (n,) [s]."""
    if not np.any(duration):
        return inside(t, spans)
    edges = np.array(spans).reshape(-1, 2)
    if not edges.size:
        return np.zeros(len(t))
    within = np.cumsum(np.column_stack([np.zeros(len(edges)), edges[:, 1] - edges[:, 0]]))  # of the time up to an edge
    before, after = (np.interp(t + half, edges.ravel(), within) for half in (-duration / 2, duration / 2))
    share: Floats = (after - before) / duration
    return share


def union(spans: Spans, other: Spans) -> Spans:
    """Union of two sets of times."""
    joined: list[tuple[float, float]] = []
    for start, end in sorted((*spans, *other)):
        if joined and start <= joined[-1][1]:
            joined[-1] = (joined[-1][0], max(end, joined[-1][1]))
        else:
            joined.append((start, end))
    return tuple(joined)


def cut(spans: Spans, other: Spans) -> Spans:
    """Union of two sets of times, cut wherever a span of either begins or ends."""
    edges = sorted({edge for span in (*spans, *other) for edge in span})
    within = union(spans, other)
    return tuple((a, b) for a, b in pairwise(edges) if any(start <= a and b <= end for start, end in within))


def without(spans: Spans, other: Spans) -> Spans:
    """Difference of two sets of times: times within ``spans`` and outside ``other``."""
    left: list[tuple[float, float]] = []
    for start, end in spans:
        for other_start, other_end in sorted(other):
            if start < other_end and other_start < end:
                left += [(start, other_start)] if start < other_start else []
                start = max(start, other_end)
        left += [(start, end)] if start < end else []
    return tuple(left)

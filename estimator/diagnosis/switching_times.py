"""Proposed times of an effect that no signal shows: switching by a hidden Markov chain, windows, steps.

Times are searched on the residual averaged over BEAT. They are proposals: their evidence is computed on the samples,
less a cost for each change of state, which is the log prior probability of its time.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.components.switching import MAX_ON_SHARE
from estimator.diagnosis.model import Model
from estimator.model.design_matrix import Spans, inside
from estimator.signals import Floats, Mask, Quantity

BEAT = 2.0  # s
MIN_WINDOW = 60.0  # s in which an effect is on, all stretches together
MAX_DWELL_FACTOR = 6.0  # by which the mean stretch may be shorter or longer than the usual one
MAX_PASSES = 6  # alternations of states and levels
START_QUANTILES = (0.1, 0.25, 0.5, 0.75, 0.9)  # of the residual, between the two levels of the first states
SCAN_STEP = 10.0  # s, of the ends of windows that are tried


@dataclass(frozen=True, kw_only=True)
class Beats:
    """The residual and a profile, averaged; all arrays (n,). ``of`` is the beat of each sample."""

    t: Floats
    residual: Floats
    profile: Floats
    weight: Floats  # samples in each
    of: NDArray[np.int64]


def beats(model: Model, profile: Floats) -> Beats:
    """Average the residual of ``model`` and a ``profile`` (samples,) [W] over BEAT."""
    number = np.floor((model.samples.t - model.samples.t[0]) / BEAT).astype(np.int64)
    starts = np.flatnonzero(np.diff(number, prepend=-1))
    count = np.diff(np.append(starts, len(number)))
    of = np.cumsum(np.diff(number, prepend=-1) != 0) - 1

    def mean(x: Floats) -> Floats:
        averaged: Floats = np.add.reduceat(x, starts) / count
        return averaged

    return Beats(
        t=mean(model.samples.t),
        residual=mean(model.base.residual),
        profile=mean(profile),
        weight=count.astype(float),
        of=of,
    )


def switching(model: Model, profile: Floats, dwell: float) -> list[Spans]:
    """Proposals for when an effect with this ``profile`` (n,) [W] was on.

    Viterbi's path of two states through the residual, its level and base refitted in turn.
    """
    b = beats(model, profile)
    proposals: list[Spans] = []
    size = np.abs(b.profile) > 1e-3 * np.abs(b.profile).max()
    if not size.any():
        return []
    ratio = np.where(size, b.residual / np.where(size, b.profile, 1.0), np.nan)
    # Columns of the base model, refitted with the level.
    columns = _beat_columns(model, b)
    for quantile in START_QUANTILES:
        on = ratio > np.nanquantile(ratio, quantile)
        for _ in range(MAX_PASSES):
            fitted = _levels(b, on, columns)
            if fitted is None:
                break
            rest, level, spread = fitted
            new = _viterbi(b, rest, level, spread, dwell)
            if np.array_equal(new, on):
                break
            on = new
        if fitted is not None and fitted[1] > 0 and MIN_WINDOW < on.sum() * BEAT < MAX_ON_SHARE * len(on) * BEAT:
            proposals.append(_spans(model, on[b.of]))
    return proposals


def is_usual(spans: Spans, dwells: tuple[float, ...]) -> bool:
    """Whether the mean stretch is within MAX_DWELL_FACTOR of one of the usual ``dwells`` [s]."""
    lasting = sum(end - start for start, end in spans) / len(spans) + BEAT
    return any(dwell / MAX_DWELL_FACTOR < lasting < dwell * MAX_DWELL_FACTOR for dwell in dwells)


def _beat_columns(model: Model, b: Beats) -> Floats:
    starts = np.flatnonzero(np.diff(b.of, prepend=-1))
    averaged: Floats = np.add.reduceat(model.base.X, starts, axis=0) / b.weight[:, None]
    averaged /= np.sqrt((averaged**2).mean(axis=0))
    return averaged


def _levels(b: Beats, on: Mask, columns: Floats) -> tuple[Floats, float, float] | None:
    """Residual without the base but with the effect (n,), the effect's level, and sd of the noise."""
    if not 0 < on.sum() < len(on):
        return None
    h = b.profile * on
    X = np.column_stack([columns, h / max(np.abs(h).max(), 1e-9)])
    solution = np.linalg.lstsq(X, b.residual, rcond=None)[0]
    level = float(solution[-1]) / max(np.abs(h).max(), 1e-9)
    rest = b.residual - X[:, :-1] @ solution[:-1]
    left = rest - level * h
    return rest, level, _independent_sd(left)


def _independent_sd(left: Floats) -> float:
    """Standard deviation of independent beats with the same information as the correlated ones ``left`` (n,)."""
    correlation = float(np.clip(np.corrcoef(left[1:], left[:-1])[0, 1], 0.0, 0.9))
    return float(left.std()) * float(np.sqrt((1 + correlation) / (1 - correlation)))


def _viterbi(b: Beats, rest: Floats, level: float, spread: float, dwell: float) -> Mask:
    """Most likely states (n,) given the two levels."""
    gain = (rest**2 - (rest - level * b.profile) ** 2) / (2 * spread**2)  # log likelihood of on over off
    change = np.log(-np.expm1(-np.diff(b.t, prepend=b.t[0] - BEAT) / dwell) / 2)
    stay = np.log1p(-np.exp(change))
    n = len(rest)
    came_from_on, came_from_off = np.zeros(n, bool), np.zeros(n, bool)
    off, on = 0.0, gain[0]
    for k in range(1, n):
        to_off, to_on = on + change[k], off + change[k]
        off, on = off + stay[k], on + stay[k]
        if to_off > off:
            came_from_on[k], new_off = True, to_off
        else:
            new_off = off
        if to_on > on:
            came_from_off[k], new_on = True, to_on
        else:
            new_on = on
        off, on = new_off, new_on + gain[k]
    states = np.zeros(n, bool)
    state = on > off
    for k in range(n - 1, -1, -1):
        states[k] = state
        state = (not came_from_off[k]) if state else bool(came_from_on[k])
    return states


def again(model: Model, i: int, dwell: float) -> Spans:
    """Times of the switching term ``i`` of ``model``, fitted again with the road load of the model."""
    own, _ = model.views()
    term, value = model.terms[i], model.magnitudes[i]
    b = beats(model, value * term.effect.power(own, None))
    on = inside(b.t, term.spans or ()) > 0
    rest = b.residual + b.profile * on
    return _spans(model, _viterbi(b, rest, 1.0, _independent_sd(rest - b.profile * on), dwell)[b.of])


def windows(model: Model, profile: Floats) -> list[Spans]:
    """The window in which an effect with this ``profile`` (n,) [W] explains most, or no window."""
    b = beats(model, profile)
    columns = _beat_columns(model, b)
    # Least squares on beats, without instruments: no profile here contains the acceleration.
    Q = np.linalg.qr(columns)[0]
    y = b.residual - Q @ (Q.T @ b.residual)
    g = b.profile
    number = np.floor((b.t - b.t[0]) / SCAN_STEP).astype(np.int64)
    edges = np.append(np.flatnonzero(np.diff(number, prepend=-1)), len(g))
    sums = np.vstack([np.zeros(2 + Q.shape[1]), np.cumsum(np.column_stack([g * y, g * g, Q * g[:, None]]), axis=0)])[
        edges
    ]
    first, last = np.triu_indices(len(edges), k=1)
    times = np.append(b.t, b.t[-1] + BEAT)[edges]
    long = (times[last] - times[first] >= MIN_WINDOW) & (times[last] - times[first] < 0.97 * (times[-1] - times[0]))
    first, last = first[long], last[long]
    if not len(first):
        return []
    difference = sums[last] - sums[first]
    strength = difference[:, 1] - (difference[:, 2:] ** 2).sum(axis=1)
    useful = (strength > 0.02 * difference[:, 1]) & (difference[:, 0] > 0)
    gain = np.where(useful, difference[:, 0] ** 2 / np.where(useful, strength, 1.0), 0.0)
    best = int(np.argmax(gain))
    if gain[best] <= 0:
        return []
    start, end = _refine(y, g, Q, int(edges[first[best]]), int(edges[last[best]]))
    if end - start < MIN_WINDOW / BEAT:
        return []
    on = np.zeros(len(g), dtype=bool)
    on[start:end] = True
    return [_spans(model, on[b.of])]


def _refine(y: Floats, g: Floats, Q: Floats, start: int, end: int) -> tuple[int, int]:
    """The ends of a window, each moved by up to two SCAN_STEP to where the window explains most."""
    reach = round(2 * SCAN_STEP / BEAT)
    sums = np.vstack([np.zeros(2 + Q.shape[1]), np.cumsum(np.column_stack([g * y, g * g, Q * g[:, None]]), axis=0)])
    for _ in range(3):
        for which in (0, 1):
            places = np.arange(max((start, end)[which] - reach, 0), min((start, end)[which] + reach + 1, len(g) + 1))
            difference = sums[end] - sums[places] if which == 0 else sums[places] - sums[start]
            strength = difference[:, 1] - (difference[:, 2:] ** 2).sum(axis=1)
            ok = (strength > 0) & ((places < end) if which == 0 else (places > start))
            gain = np.where(ok, difference[:, 0] ** 2 / np.where(ok, strength, 1.0), 0.0)
            chosen = int(places[np.argmax(gain)])
            start, end = (chosen, end) if which == 0 else (start, chosen)
    return start, end


def steps(model: Model) -> list[Spans]:
    """From each standstill to the end, where enough was driven on both sides."""
    stops = model.samples.context[Quantity.STOPS]
    after = [stops >= k for k in range(1, int(stops.max()) + 1)]
    return [_spans(model, on) for on in after if 0.05 < on.mean() < 0.95]


def _spans(model: Model, on: Mask) -> Spans:
    """From and to [s] of the stretches in which ``on`` (n,) holds."""
    t = model.samples.t
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]])))
    return tuple((float(t[a]), float(t[b - 1])) for a, b in edges.reshape(-1, 2).tolist())


def between(model: Model, spans: Spans) -> Spans:
    """The times between ``spans``."""
    return _spans(model, inside(model.samples.t, spans) == 0)


def changes(model: Model, spans: Spans) -> int:
    """How often the state changes within the drive."""
    t = model.samples.t
    return sum((start > t[0]) + (end < t[-1]) for start, end in spans)

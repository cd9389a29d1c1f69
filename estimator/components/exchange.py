"""Find the blocks of a drive in which an effect is on, by exchanging runs of blocks.

The amplitude b and the times z (one of two states for each block) have the log evidence

    1/2 (z's)^2 / (z'Gz + 1/sd^2) - 1/2 log(1 + sd^2 z'Gz) - costs of changes of state

with s and G the scores and products of a profile cut into blocks, everything else in the model eliminated. The costs
are those of `time_prior.py`. Every run of blocks is tried; the best is switched on or off as long as evidence rises.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimator.components.time_prior import Costs
from estimator.estimation.savage_dickey import log_bayes_factor, posterior_of
from estimator.signals import Floats, Mask

MAX_RUN = 2000.0  # s, of several blocks exchanged at once
MAX_EXCHANGES = 60  # bounds the run time


def best_states(
    G: Floats, s: Floats, sd: float, positive: bool, single: bool, lengths: Floats, costs: Sequence[Costs]
) -> Mask:
    """Blocks (b,) that are on; ``lengths`` (b,) [s] of blocks, ``costs`` (b - 1,) of changes between them.

    ``single``: at most one run of blocks is on.
    """
    b = len(s)
    on, changes = np.zeros(b, dtype=bool), Changes(costs)
    ends = np.insert(np.cumsum(lengths), 0, 0.0)
    furthest = np.full(b, b) if single else np.searchsorted(ends, ends[:-1] + MAX_RUN, side="right") - 1
    furthest = np.maximum(furthest, np.arange(1, b + 1))
    corner = np.zeros((b + 1, b + 1))
    corner[1:, 1:] = G.cumsum(axis=0).cumsum(axis=1)
    square = corner.diagonal()  # a run has the strength square[first] + square[last] - 2 corner[first, last]
    best = 0.0
    for _ in range(MAX_EXCHANGES):
        first, last = _runs(on, furthest)
        active, switch = on.astype(float), np.where(on, -1.0, 1.0)
        score, strength = float(s @ active), float(active @ G @ active)
        scores, crosses = (np.insert(np.cumsum(values), 0, 0.0) for values in (switch * s, 2 * switch * (G @ active)))
        gain = amplitude_evidence(
            score + scores[last] - scores[first],
            strength + (crosses + square)[last] - (crosses - square)[first] - 2 * corner[first, last],
            sd,
            positive,
        )
        gain -= changes.cost(on) + switch[first] * changes.by_run(on, first, last)
        if single:
            gain[np.count_nonzero(np.diff(np.pad(on, 1))) + switch[first] * edges_by_run(on, first, last) > 2] = -np.inf
        k = int(np.argmax(gain))
        if gain[k] <= best + 1e-9:
            break
        best = float(gain[k])
        on[first[k] : last[k]] ^= True
    return on


def _runs(on: Mask, furthest: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """All runs of blocks in one state: the first block (r,) of each, and the block (r,) after its last one.

    A run ends before the block ``furthest`` (b,) for its first one.
    """
    b = len(on)
    changed = np.append(np.flatnonzero(on[1:] != on[:-1]) + 1, b)  # blocks where the next state begins
    reached = np.minimum(changed[np.searchsorted(changed, np.arange(b), side="right")], furthest)
    counts = reached - np.arange(b)
    first = np.repeat(np.arange(b), counts)
    last = np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts) + first + 1
    return first, last


class Changes:
    """Prior costs [nats] of the states of b blocks, from the ``costs`` (b - 1,) of transitions between them."""

    def __init__(self, costs: Sequence[Costs]) -> None:
        self._begins, self._ends, self._stays = (
            np.array([getattr(cost, name) for cost in costs]) for name in ("begins", "ends", "stays")
        )

    def cost(self, on: Mask) -> float:
        """Prior cost [nats] of states ``on`` (b,)."""
        before, after = on[:-1], on[1:]
        return float(self._begins @ (~before & after) + self._ends @ (before & ~after) + self._stays @ (before & after))

    def by_run(self, on: Mask, first: NDArray[np.intp], last: NDArray[np.intp]) -> Floats:
        """Change of prior cost (r,) [nats] if a run of blocks is on, relative to off.

        Run i has the blocks from ``first[i]`` to before ``last[i]``, all in one state at present.
        """
        left = np.append(np.where(on[:-1], self._stays - self._ends, self._begins), 0.0)  # with the block before it
        right = np.append(np.where(on[1:], self._stays - self._begins, self._ends), 0.0)  # with the block after it
        within = np.insert(np.cumsum(self._stays), 0, 0.0)
        cost: Floats = (np.roll(left, 1) - within)[first] + (within + right)[last - 1]
        return cost


def edges_by_run(on: Mask, first: NDArray[np.intp], last: NDArray[np.intp]) -> NDArray[np.int64]:
    """Change of the number of edges (r,) if a run of blocks is on, relative to off; the drive's ends are edges too."""
    outside = np.pad(on, 1)
    edges: NDArray[np.int64] = 2 - 2 * outside[first].astype(np.int64) - 2 * outside[last + 1]
    return edges


def amplitude_evidence(score: Floats, strength: Floats, sd: float, positive: bool) -> Floats:
    """Log Bayes factor (k,) of one amplitude against none; minus infinity if ``positive`` and the score is negative.

    ``score`` (k,) and ``strength`` (k,): moment and squared norm of its column, everything else eliminated.
    """
    gain = log_bayes_factor(*posterior_of(score, strength, sd), sd)
    allowed: Floats = np.where((score > 0) | (not positive), gain, -np.inf)
    return allowed

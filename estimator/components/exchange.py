"""Find the blocks of a drive in which effects are on, by exchanging runs of blocks.

The amplitude b of one effect and its states z (on or off in each block) have the log evidence

    1/2 (z's)^2 / (z'Gz + 1/sd^2) - 1/2 log(1 + sd^2 z'Gz) - costs of changes of state

with s and G the scores and products of a profile cut into blocks, everything else in the model eliminated. The costs
are those of `time_prior.py`. Every run of blocks is tried; the best is switched on or off as long as evidence rises.

Two effects have one such evidence together. A run may also be switched in both at once: where one is on and the other
off, it passes from one to the other. What one effect explains in place of the other is found in this way only, because
either change alone lowers the evidence.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from estimator.components.time_prior import Costs
from estimator.estimation.savage_dickey import first_eliminated, log_bayes_factor, posterior_of
from estimator.signals import Floats, Mask

MIN_GAIN = 1e-3  # of log evidence, for a further change of times: above rounding, so that changes end


@dataclass(frozen=True)
class SwitchingPrior:
    """Prior of the amplitude of an effect, and of its states in b blocks.

    ``costs`` (b - 1,) are those of changes between blocks; ``is_single``: at most one run of blocks is on.
    """

    sd: float
    is_positive: bool
    is_single: bool
    costs: Sequence[Costs]


def best_states(G: Floats, s: Floats, priors: Sequence[SwitchingPrior], start: Mask) -> Mask:
    """Blocks (e, b) in which each of e effects is on, from those of ``start`` (e, b).

    ``G`` (e, e, b, b): products, ``s`` (e, b): scores of the blocks of all effects.
    """
    effects = len(s)
    moves = [list(some) for size in range(effects) for some in combinations(range(effects), size + 1)]
    on, blocks = start.copy(), _Blocks(G, s, priors)
    while True:
        first, last = _runs(on)
        moved, present = blocks.evidence_of_moves(on, first, last, moves)
        move, k = np.unravel_index(np.argmax(moved), moved.shape)
        if moved[move, k] <= present + MIN_GAIN:
            return on
        on[moves[move], first[k] : last[k]] ^= True


def _runs(on: Mask) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The first block (r,) of each run of blocks in which no state (e, b) changes, and the block after its last."""
    b = on.shape[1]
    changed = np.append(np.flatnonzero((on[:, 1:] != on[:, :-1]).any(axis=0)) + 1, b)  # where the next states begin
    counts = changed[np.searchsorted(changed, np.arange(b), side="right")] - np.arange(b)
    first = np.repeat(np.arange(b), counts)
    last = np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts) + first + 1
    return first, last


class _Blocks:
    """Evidence of states of effects, from the products ``G`` (e, e, b, b) and scores ``s`` (e, b) of their blocks."""

    def __init__(self, G: Floats, s: Floats, priors: Sequence[SwitchingPrior]) -> None:
        self._G, self._s, self._priors = G, s, priors
        self._changes = [Changes(prior.costs) for prior in priors]
        corners = np.zeros((*G.shape[:2], G.shape[2] + 1, G.shape[3] + 1))
        corners[..., 1:, 1:] = G.cumsum(axis=-2).cumsum(axis=-1)
        # A run has the product squares[first] + squares[last] - crossed[first, last].
        self._squares = np.diagonal(corners, axis1=-2, axis2=-1)
        self._crossed = corners + np.swapaxes(corners, -1, -2)

    def evidence_of_moves(
        self, on: Mask, first: NDArray[np.intp], last: NDArray[np.intp], moves: Sequence[Sequence[int]]
    ) -> tuple[Floats, float]:
        """Log evidence (x, r) after each of x ``moves`` with each run of blocks, and that of the states ``on`` (e, b).

        A move exchanges the states of some effects, by number, in all blocks of the run.
        """
        active, switch = on.astype(float), np.where(on, -1.0, 1.0)
        products = (self._G @ active[:, :, None])[..., 0]
        score, strength = (self._s * active).sum(axis=-1), (active[:, None] * products).sum(axis=-1)
        costs = [changes.cost(state) for changes, state in zip(self._changes, on, strict=True)]
        more_score, more_strength = _cumulated(switch * self._s), _cumulated(switch[:, None] * products)
        evidence = np.empty((len(moves), len(first)))
        for row, effects in zip(evidence, moves, strict=True):
            scores, strengths = np.tile(score[:, None], len(first)), np.tile(strength[..., None], len(first))
            paid = np.full(len(first), sum(costs))
            for c in effects:
                scores[c] += more_score[c, last] - more_score[c, first]
                for d in range(len(on)):
                    change = more_strength[c, d, last] - more_strength[c, d, first]
                    strengths[c, d] += change
                    strengths[d, c] += change
                for d in effects:
                    product = self._squares[c, d][last] + self._squares[c, d][first] - self._crossed[c, d][first, last]
                    strengths[c, d] += (switch[c] * switch[d])[first] * product
                paid += switch[c][first] * self._changes[c].by_run(on[c], first, last)
                if self._priors[c].is_single:
                    edges = np.count_nonzero(np.diff(np.pad(on[c], 1)))
                    paid[edges + switch[c][first] * edges_by_run(on[c], first, last) > 2] = np.inf
            row[:] = self._evidence(scores, strengths) - paid
        return evidence, float(self._evidence(score, strength)) - sum(costs)

    def _evidence(self, score: Floats, strength: Floats) -> Floats:
        return joint_evidence(
            score, strength, [prior.sd for prior in self._priors], [prior.is_positive for prior in self._priors]
        )


def _cumulated(values: Floats) -> Floats:
    """Sums (..., b + 1) of ``values`` (..., b) before each of them and after the last."""
    return np.concatenate([np.zeros((*values.shape[:-1], 1)), np.cumsum(values, axis=-1)], axis=-1)


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


def joint_evidence(score: Floats, strength: Floats, sds: Sequence[float], positive: Sequence[bool]) -> Floats:
    """Log Bayes factor (...) of e amplitudes against none; minus infinity where one that is ``positive`` is negative.

    ``score`` (e, ...) and ``strength`` (e, e, ...): moments and products of their columns, all else eliminated. One
    amplitude after the other is eliminated, and its factor is that given those after it at zero.
    """
    rest, remaining = score, strength
    gain, factors = np.zeros(score.shape[1:]), list[tuple[Floats, Floats]]()
    for sd in sds:
        value, spread = posterior_of(rest[0], remaining[0, 0], sd)
        gain = gain + log_bayes_factor(value, spread, sd)
        factors.append((value, remaining[0, 1:] * spread**2))
        rest, remaining = first_eliminated(rest, remaining, sd)
    values = np.zeros(score.shape)
    for c in reversed(range(len(sds))):  # given those of the later ones
        value, along = factors[c]
        values[c] = value - (along * values[c + 1 :]).sum(axis=0)
        if positive[c]:
            gain = np.where(values[c] < 0, -np.inf, gain)
    return gain

"""Refine fitted times: move the edges of spans where that adds evidence.

Blocks of `switching.py` end at whole strides, and noise displaces their ends by some strides. Moving an edge changes
the column of a few strides, so the evidence of any move follows from the products of these strides.
"""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from estimator.components.exchange import MIN_GAIN
from estimator.components.likelihood import JointLikelihood
from estimator.components.time_prior import cost_of_leaving
from estimator.estimation.savage_dickey import first_eliminated, log_bayes_factor, posterior_of
from estimator.model.effect_term import EffectTerm
from estimator.model.spans import Spans
from estimator.signals import Floats
from estimator.strides import DURATION

STEPS = np.concatenate([np.arange(1, 11) / 10, np.arange(1.5, 4.5, 0.5)])  # s, by which an edge is moved
MOVES = np.concatenate([-STEPS, STEPS])
TOGETHER = 100  # moves whose products are computed at once: bounds the memory with many edges


def with_refined_edges(
    joint: JointLikelihood, chosen: list[int], effect_term: EffectTerm, beside: Sequence[EffectTerm] = ()
) -> Spans:
    """Spans of ``effect_term`` with beginnings and ends moved by up to STEPS.max() where that adds evidence.

    It acts beside the ``chosen`` terms of the likelihood, and those ``beside``, which the likelihood need not have.
    An edge leaves the gap that it lies in if the gain exceeds the cost of leaving.
    """
    spans, t = effect_term.spans or (), joint.frame.strides.t
    edges = [(i, side) for i in range(len(spans)) for side in (0, 1) if t[0] < spans[i][side] < t[-1]]
    half = 0.5 * min([2.1 * STEPS.max(), *(b - a for a, b in spans), *(b[0] - a[1] for a, b in pairwise(spans))])
    moves = MOVES[np.abs(MOVES) < half]
    leaving = [cost_of_leaving(spans[i][side], side == 1, effect_term.effect, t) for i, side in edges]
    column = _Column(
        *_products(joint, chosen, effect_term, edges, moves, beside),
        sd=effect_term.effect.usual_magnitude(joint.frame.road_load),
    )
    edited = [list(span) for span in spans]
    for (i, side), move in zip(edges, _best_moves(column, leaving, len(moves)), strict=True):
        if move >= 0:
            edited[i][side] += float(moves[move])
    return tuple((a, b) for a, b in edited)


def _products(
    joint: JointLikelihood,
    chosen: list[int],
    effect_term: EffectTerm,
    edges: Sequence[tuple[int, int]],
    moves: Floats,
    beside: Sequence[EffectTerm],
) -> tuple[Floats, Floats, sp.csc_array]:
    """Products (1 + n, 1 + n), scores (1 + n,) and composition (1 + n, 1 + k) of a column and its moves.

    Products and scores are of the term's column and of each of n strides near its edges. The composition states the
    column (its first column) and the change by each move of each edge as sums of these.
    """
    spans, t = effect_term.spans or (), joint.frame.strides.t
    profile, column = joint.frame.column(replace(effect_term, spans=None)), joint.frame.column(effect_term)
    near = _strides_near(t, [spans[i][side] for i, side in edges], float(np.abs(moves).max(initial=0.0)))
    moved = [sp.csc_array((profile[near] * _share_change(t[near], spans[i][side], moves, side)).T) for i, side in edges]
    single = sp.csc_array((np.ones(len(near)), near, np.arange(len(near) + 1)), (len(t), len(near)))
    known = [sp.csc_array(joint.frame.column(other)[:, None]) for other in beside]
    G, s = joint.projected(chosen, sp.hstack([*known, sp.csc_array(column[:, None]), single], format="csc"))
    for other in beside:
        s, G = first_eliminated(s, G, other.effect.usual_magnitude(joint.frame.road_load))
    changes = sp.hstack(moved, format="csc") if moved else sp.csc_array((len(near), 0))
    return G, s, sp.block_diag([sp.csc_array([[1.0]]), changes], format="csc")


def _strides_near(t: Floats, edges: Sequence[float], furthest: float) -> NDArray[np.intp]:
    """Strides (k,) whose covered share may change when ``edges`` [s] are moved by up to ``furthest`` [s]."""
    reached = np.zeros(len(t), dtype=bool)
    for edge in edges:
        reached |= np.abs(t - edge) < furthest + DURATION / 2
    return np.flatnonzero(reached)


def _share_change(t: Floats, edge: float, moves: Floats, side: int) -> Floats:
    """Change (k, n) of the covered share of each stride when the ``edge`` [s] of a span makes k ``moves`` [s]."""
    before = np.clip((edge - t) / DURATION + 0.5, 0.0, 1.0)  # share of each stride before the edge
    after = np.clip((edge + moves[:, None] - t) / DURATION + 0.5, 0.0, 1.0)
    more: Floats = after - before
    return more if side == 1 else -more


def _best_moves(column: "_Column", leaving: Sequence[float], number: int) -> list[int]:
    """Move of each edge, among ``number``, or -1 for none; ``leaving``: cost [nats] of any move of an edge.

    Coordinate ascent: one edge after the other takes its best move given those of the others, until the gain is small.
    """
    taken, paid = [-1] * len(leaving), 0.0
    best, previous = float(column.evidence()), -np.inf
    while best > previous + MIN_GAIN:
        previous = best
        for k, cost in enumerate(leaving):
            columns = 1 + k * number + np.arange(number)
            if taken[k] >= 0:
                column.change(columns[taken[k]], -1.0)
                paid -= cost
            stay = float(column.evidence()) - paid
            gains = column.evidence_with(columns) - (paid + cost)
            taken[k] = int(np.argmax(gains)) if gains.max(initial=-np.inf) > stay else -1
            best = max(float(gains.max(initial=-np.inf)), stay)
            if taken[k] >= 0:
                column.change(columns[taken[k]], 1.0)
                paid += cost
    return taken


class _Column:
    """A column with optional changes: the first of ``made`` (n, 1 + k) is the column, the others may be added to it.

    ``G`` (n, n): products, ``s`` (n,): scores of the n parts, everything else eliminated; ``sd``: prior of its
    amplitude.
    """

    def __init__(self, G: Floats, s: Floats, made: sp.csc_array, sd: float) -> None:
        self._G, self._made, self._transposed, self._sd = G, made, made.T, sd
        self._s: Floats = self._transposed @ s
        some = [made[:, at : at + TOGETHER] for at in range(0, made.shape[1], TOGETHER)]
        self._squares = np.concatenate([part.multiply(G @ part).sum(axis=0) for part in some])
        self._score, self._strength, self._cross = float(self._s[0]), float(self._squares[0]), self._products_with(0)

    def _products_with(self, k: int) -> Floats:
        """Products (1 + k,) of column ``k`` with all columns."""
        elements = slice(self._made.indptr[k], self._made.indptr[k + 1])
        products: Floats = self._transposed @ (self._G[:, self._made.indices[elements]] @ self._made.data[elements])
        return products

    def change(self, k: int, sign: float) -> None:
        """Add the change ``k`` (``sign`` 1), or remove it again (-1)."""
        self._score += sign * float(self._s[k])
        self._strength += 2 * sign * float(self._cross[k]) + float(self._squares[k])
        self._cross += sign * self._products_with(k)

    def evidence(self) -> Floats:
        """Log evidence of the amplitude of the column."""
        return log_bayes_factor(*posterior_of(self._score, self._strength, self._sd), self._sd)

    def evidence_with(self, changes: NDArray[np.intp]) -> Floats:
        """Log evidence (c,) of the amplitude with each of ``changes`` (c,) added alone."""
        score, strength = (
            self._score + self._s[changes],
            self._strength + 2 * self._cross[changes] + self._squares[changes],
        )
        return log_bayes_factor(*posterior_of(score, strength, self._sd), self._sd)

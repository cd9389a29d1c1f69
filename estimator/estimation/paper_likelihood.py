"""The paper's likelihood of the samples with power above 0 in a window, updated block by block.

Each block is condensed once, for a region of parameters far wider than the posterior, and the window's total is the
sum over its blocks: rounding errors do not accumulate over days, and an update costs a pass over the new block and over
the few samples that might be clipped. When the posterior leaves the region, or becomes much narrower than it, all
blocks are condensed again: as the window fills, each time the deviations have halved.

Drag is proportional to the density of the air, and C refers to its mean over the window, which every block changes. So
the columns of a block do not use the mean: they are [v, v^3, rho v^3, v a], the second where the density rho is not
known, the third where it is, with coefficients [A, C, C / mean rho, m].
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from estimator.checkpoint.validation import State, array, optional
from estimator.errors import StateError
from estimator.model.road_load import design
from estimator.samples import Samples
from estimator.sampling.clipped import ClippedGaussianTarget
from estimator.sampling.condensed import Condensed, Region
from estimator.signals import Floats

COLUMNS = 4  # of a block, see the module
AIR_COLUMN = 2  # proportional to the density
REGION_SDS = 64.0  # radius of the region when blocks are condensed, in sd of the posterior
MIN_REGION_SDS, MAX_REGION_SDS = 32.0, 128.0  # the same of the newest posterior: outside, blocks are condensed again
MAX_DENSITY_CHANGE = 0.05  # by which the mean density may change without leaving the region


@dataclass(frozen=True)
class _Block:
    """Columns ``X`` (n, 4) and power ``P`` (n,) [W]; the ``density`` that is known, summed over ``known`` samples."""

    X: Floats
    P: Floats
    density: float
    known: int

    @classmethod
    def of(cls, samples: Samples) -> "_Block":
        positive = samples.P > 0
        density = samples.density[positive]
        known = np.isfinite(density)
        v, drag, va = design(samples.v[positive], samples.a[positive]).T
        X = np.column_stack([v, np.where(known, 0.0, drag), np.where(known, density * drag, 0.0), va])
        return cls(X, samples.P[positive], float(density[known].sum()), int(known.sum()))


class PaperLikelihood:
    """Follows a window from update to update."""

    def __init__(self) -> None:
        self._blocks: dict[int, _Block] = {}
        self._region: Region | None = None
        self._condensed: dict[int, Condensed] = {}

    def target(self, blocks: Mapping[int, Samples], lower: Floats, upper: Floats) -> ClippedGaussianTarget:
        """Of A [N], C [N s^2/m^2] and m [kg] in the box (3,), given the ``blocks`` that are held now.

        The key of a block is unique among all blocks, past and future.
        """
        self._blocks = {key: self._blocks.get(key) or _Block.of(blocks[key]) for key in blocks}
        held = list(self._blocks.values())
        M, everything = _mixing(held), partial(_stacked, held)
        if held and (region := self._region):
            have = self._condensed
            self._condensed = {key: have.get(key) or region.condense(x.X, x.P) for key, x in self._blocks.items()}
            samples = Condensed.total(list(self._condensed.values()))
            target = ClippedGaussianTarget(samples, M, everything, lower, upper)
            if MIN_REGION_SDS <= target.reach <= MAX_REGION_SDS:
                return target
        target = ClippedGaussianTarget(Condensed.of(*everything()), M, everything, lower, upper)
        phi, covariance = M @ target.centre, REGION_SDS**2 * target.root @ target.root.T
        covariance[AIR_COLUMN, AIR_COLUMN] += MAX_DENSITY_CHANGE**2 * (
            covariance[AIR_COLUMN, AIR_COLUMN] + phi[AIR_COLUMN] ** 2
        )
        self._region, self._condensed = Region.around(phi, covariance), {}
        return target

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads, exact to the bit; the blocks are saved with the window."""
        region = self._region
        return {"region": None if region is None else {"origin": region.origin, "whiten": region.whiten}}

    def restore(self, state: State) -> None:
        """Condense for the same region as another did.

        Raises
        ------
        StateError
            The state is none of this likelihood.
        """
        self._region = optional(state, "region", _restore_region)
        self._blocks, self._condensed = {}, {}


def _mixing(blocks: Sequence[_Block]) -> Floats:
    """From [A, C, m] to the coefficients of the columns (4, 3)."""
    known = sum(block.known for block in blocks)
    mean = sum(block.density for block in blocks) / known if known else 1.0
    return np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 1.0 / mean, 0.0], [0.0, 0.0, 1.0]])


def _stacked(blocks: Sequence[_Block]) -> tuple[Floats, Floats]:
    """Columns (n, 4) and power (n,) of all."""
    X, P = [np.empty((0, COLUMNS)), *(x.X for x in blocks)], [np.empty(0), *(x.P for x in blocks)]
    return np.concatenate(X), np.concatenate(P)


def _restore_region(state: State) -> Region:
    whiten = array(state, "whiten", (COLUMNS, COLUMNS))
    if np.any(np.triu(whiten, 1)) or np.any(np.diag(whiten) <= 0):
        raise StateError("whiten: is no inverse of a Cholesky factor")
    return Region(array(state, "origin", (COLUMNS,)), whiten)

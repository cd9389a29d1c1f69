"""The bounded memory of admitted samples: blocks of consecutive driving, rare cells kept longest."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.config import Config
from estimator.errors import StateError
from estimator.samples import Samples
from estimator.signals import Floats
from estimator.state import Count, State, array, read, substate

LOWEST_ACCELERATION = -1.0  # m/s^2, where the grid of cells begins
SPEED_CELLS = 64
ACCELERATION_CELLS = 64


@dataclass(frozen=True)
class Grid:
    """Cells of speed x acceleration, numbered row by row; values beyond the last cell fall into it."""

    speed_step: float  # [m/s]
    acceleration_step: float  # [m/s^2]

    size = SPEED_CELLS * ACCELERATION_CELLS

    def cell(self, v: Floats, a: Floats) -> NDArray[np.int64]:
        """Cell number (n,) of each speed [m/s] and acceleration [m/s^2]."""
        row = np.clip(np.floor(v / self.speed_step), 0, SPEED_CELLS - 1)
        column = np.floor((a - LOWEST_ACCELERATION) / self.acceleration_step)
        cell: NDArray[np.int64] = (row * ACCELERATION_CELLS + np.clip(column, 0, ACCELERATION_CELLS - 1)).astype(
            np.int64
        )
        return cell

    def centres(self) -> tuple[Floats, Floats]:
        """Speed [m/s] and acceleration [m/s^2] in the middle of every cell (size,)."""
        row, column = np.divmod(np.arange(self.size), ACCELERATION_CELLS)
        return (row + 0.5) * self.speed_step, LOWEST_ACCELERATION + (column + 0.5) * self.acceleration_step


class Window:
    """Holds at most ``config.window.samples``, none older than ``config.window.hours``.

    When it is full, the block whose samples lie in the fullest cells goes first, so hours of cruising do not push
    out the few accelerations that identify the mass. The choice depends on the instruments of speed and acceleration
    alone: what is kept for its rare acceleration would be kept for the noise in it, and in the course of a day the
    window would fill with such samples; the noise of the instruments is another.
    """

    def __init__(self, config: Config) -> None:
        self.grid = Grid(config.gate.speed_step_m_s, config.gate.acceleration_step_m_s2)
        self.evicted = 0
        self.added = 0  # samples ever admitted
        self._capacity = config.window.samples
        self._longest = config.window.hours * 3600.0
        self._blocks: dict[int, Samples] = {}  # by number, in the order of time
        self._cells: dict[int, NDArray[np.int64]] = {}
        self._counts = np.zeros(self.grid.size, dtype=np.int64)  # of instruments

    def __len__(self) -> int:
        return int(self._counts.sum())

    @property
    def samples(self) -> Samples:
        """Everything in the window, oldest first."""
        return Samples.concatenate(list(self._blocks.values()))

    @property
    def blocks(self) -> Mapping[int, Samples]:
        """The same in blocks, each under a number that no other block ever has: of the samples ever admitted before."""
        return self._blocks

    @property
    def counts(self) -> NDArray[np.int64]:
        """Samples per cell of their own speed and acceleration (grid.size,)."""
        samples = self.samples
        return np.bincount(self.grid.cell(samples.v, samples.a), minlength=self.grid.size)

    def add(self, block: Samples) -> None:
        """Take a block of consecutive samples, and let go what there is no room for."""
        if not len(block):
            return
        cells = self.grid.cell(block.zv, block.za)
        self._blocks[self.added], self._cells[self.added] = block, cells
        self._counts += np.bincount(cells, minlength=self.grid.size)
        self.added += len(block)
        while self._blocks and block.t[-1] - self._blocks[oldest := min(self._blocks)].t[0] > self._longest:
            self._drop(oldest)
        while len(self) > self._capacity:
            self._drop(max(self._cells, key=lambda number: self._counts[self._cells[number]].mean()))

    def _drop(self, number: int) -> None:
        self._blocks.pop(number)
        cells = self._cells.pop(number)
        self._counts -= np.bincount(cells, minlength=self.grid.size)
        self.evicted += len(cells)

    def clear(self) -> None:
        """Forget everything, as after a change of vehicle or an unexplained step in time."""
        self._blocks, self._cells = {}, {}
        self._counts[:] = 0

    def state(self) -> dict[str, Any]:
        """What `restore` makes the same window from."""
        lengths = np.array([len(block) for block in self._blocks.values()], dtype=np.int64)
        return {
            "samples": self.samples.state(),
            "lengths": lengths,
            "added": self.added,
            "evicted": self.evicted,
        }

    def restore(self, state: State) -> None:
        """Hold what another window held.

        Raises
        ------
        StateError
            The state is not one that a window with this configuration can have.
        """
        samples, lengths = Samples.restore(substate(state, "samples")), array(state, "lengths", (-1,), np.int64)
        ends = np.cumsum(lengths)
        if np.any(lengths <= 0) or len(samples) != lengths.sum() or len(samples) > self._capacity:
            raise StateError(f"window: {len(samples)} samples in {len(lengths)} blocks cannot be")
        self.added, self.evicted = read(state, "added", Count), read(state, "evicted", Count)
        first = self.added - len(samples)
        slices = [slice(end - length, end) for end, length in zip(ends.tolist(), lengths.tolist(), strict=True)]
        self._blocks = {first + part.start: samples[part] for part in slices}
        self._cells = {number: self.grid.cell(block.zv, block.za) for number, block in self._blocks.items()}
        self._counts = np.bincount(self.grid.cell(samples.zv, samples.za), minlength=self.grid.size)

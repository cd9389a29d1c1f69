"""A bounded window of strides: blocks of consecutive driving; those in rare cells are kept longest."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.checkpoint.validation import Count, State, array, read, substate
from estimator.config import Config
from estimator.errors import StateError
from estimator.signals import Floats, Mask
from estimator.strides import Strides

MIN_ACCELERATION = -1.0  # m/s^2, where the grid of cells begins; lower values fall into its first cells
CELLS = 64  # of `gate.speed_step_m_s` and `acceleration_step_m_s2`: up to 160 m/s and 5.4 m/s^2 by default
KEPT = 0.9  # of a limit that is exceeded: what is fitted stays the same for a while, and fits go on from it


@dataclass(frozen=True)
class Grid:
    """Cells of speed x acceleration, numbered row by row; values beyond the last cell fall into it."""

    speed_step: float  # [m/s]
    acceleration_step: float  # [m/s^2]

    size = CELLS * CELLS

    def cell(self, v: Floats, a: Floats) -> NDArray[np.int64]:
        """Cell number (n,) of each speed [m/s] and acceleration [m/s^2]."""
        row = np.clip(np.floor(v / self.speed_step), 0, CELLS - 1)
        column = np.floor((a - MIN_ACCELERATION) / self.acceleration_step)
        cell: NDArray[np.int64] = (row * CELLS + np.clip(column, 0, CELLS - 1)).astype(np.int64)
        return cell

    def centres(self) -> tuple[Floats, Floats]:
        """Speed [m/s] and acceleration [m/s^2] in the middle of every cell (size,)."""
        row, column = np.divmod(np.arange(self.size), CELLS)
        return (row + 0.5) * self.speed_step, MIN_ACCELERATION + (column + 0.5) * self.acceleration_step


Cells = tuple[NDArray[np.int64], NDArray[np.int64]]  # places on the grid, and how many rows each stands for


class Window:
    """Holds at most ``config.window.samples`` rows, none older than ``config.window.hours``.

    When it is full, a tenth of it is forgotten: the block whose rows lie in the fullest cells goes first, so hours of
    cruising do not push out the few accelerations that identify the mass.

    Parameters
    ----------
    config
        All settings.
    """

    def __init__(self, config: Config) -> None:
        self.grid = Grid(config.gate.speed_step_m_s, config.gate.acceleration_step_m_s2)
        self.evicted = 0  # rows
        self.added = 0  # rows ever admitted
        self._capacity = config.window.samples
        self._longest = config.window.hours * 3600.0
        self._empty()

    def _empty(self) -> None:
        self._content = [Strides.none()]  # of all blocks, joined when they are asked for
        self._begins = np.empty(0)  # [s] of each block
        self._lengths, self._cell_lengths = np.zeros((2, 0), dtype=np.int64)  # of each block
        self._places, self._rows = np.zeros((2, 0), dtype=np.int64)  # cells, and how many rows each stands for
        self._counts = np.zeros(self.grid.size, dtype=np.int64)  # rows

    def __len__(self) -> int:
        return int(self._counts.sum())

    @property
    def strides(self) -> Strides:
        """Everything in the window, oldest first."""
        if len(self._content) > 1:
            self._content = [Strides.concatenate([part for part in self._content if len(part)])]
        return self._content[0]

    @property
    def counts(self) -> NDArray[np.int64]:
        """Rows per cell of speed and acceleration (grid.size,)."""
        return self._counts.copy()

    def add(self, block: Strides) -> None:
        """Add a block of consecutive driving, and evict blocks beyond the capacity or the age limit."""
        if not len(block):
            return
        self._content.append(block)
        self._begins, self._lengths = np.append(self._begins, block.t[0]), np.append(self._lengths, len(block))
        self._count(self._place(block.cells))
        self._evict(float(block.t[-1]))

    def _count(self, cells: Cells) -> None:
        places, rows = cells
        self._places, self._rows = np.append(self._places, places), np.append(self._rows, rows)
        self._cell_lengths = np.append(self._cell_lengths, len(places))
        self._counts += self._counted(places, rows)
        self.added += int(rows.sum())

    def _evict(self, newest: float) -> None:
        age = newest - self._begins
        if age[0] > self._longest:
            self.evicted += self._keep(age <= KEPT * self._longest)
        if len(self) > self._capacity:
            self.evicted += self._keep(self._rarest(KEPT * self._capacity))

    def _rarest(self, allowed: float) -> Mask:
        """Blocks (blocks,) of at most ``allowed`` rows that are left when the fullest ones are forgotten in turn.

        Fullness is the mean count of the cells of a block's rows. Blocks without cells only join those on either side,
        and are forgotten with one of them.
        """
        count, counts = len(self._lengths), self._counts.copy()
        kept, block = np.ones(count, dtype=bool), np.repeat(np.arange(count), self._cell_lengths)
        total = np.bincount(block, self._rows, count)
        while counts.sum() > allowed:
            filled = np.bincount(block, counts[self._places] * self._rows, count)
            fullness = np.divide(filled, total, out=np.zeros(count), where=total > 0)
            fullest = int(np.argmax(np.where(kept, fullness, -1.0)))
            kept[fullest] = False
            cells = block == fullest
            counts -= self._counted(self._places[cells], self._rows[cells])
        own = np.flatnonzero(total > 0)
        after = np.searchsorted(own, np.arange(count))  # of the blocks with cells, the one at or after each block
        is_kept = np.concatenate([[False], kept[own], [True]])  # driving after the newest block may still come
        return np.where(total > 0, kept, is_kept[after] & is_kept[after + 1])

    def _place(self, cells: tuple[Floats, Floats, NDArray[np.int64]]) -> Cells:
        speed, acceleration, rows = cells
        return self.grid.cell(speed, acceleration), rows

    def _counted(self, places: NDArray[np.int64], rows: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.bincount(places, rows, minlength=self.grid.size).astype(np.int64)

    def _keep(self, kept: Mask) -> int:
        """Forget all blocks but the ``kept`` (blocks,), and return how many rows were forgotten."""
        if kept.all():
            return 0
        before, cells = len(self), np.repeat(kept, self._cell_lengths)
        self._content = [self.strides[np.repeat(kept, self._lengths)]]
        self._places, self._rows = self._places[cells], self._rows[cells]
        self._begins, self._lengths = self._begins[kept], self._lengths[kept]
        self._cell_lengths = self._cell_lengths[kept]
        self._counts = self._counted(self._places, self._rows)
        return before - len(self)

    def forget_before(self, t: float) -> None:
        """Forget the blocks that end before time ``t`` [s]."""
        self._keep(self.strides.t[np.cumsum(self._lengths) - 1] >= t)

    def clear(self) -> None:
        """Forget everything, as after a change of vehicle or an unexplained step in time."""
        self._empty()

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads."""
        return {
            "strides": self.strides.state(),
            "lengths": self._lengths,
            "added": self.added,
            "evicted": self.evicted,
        }

    def restore(self, state: State) -> None:
        """Take the state of another one.

        Raises
        ------
        StateError
            The state is not one that a window with this configuration can have.
        """
        content, lengths = Strides.restore(substate(state, "strides")), array(state, "lengths", (-1,), np.int64)
        ends = np.cumsum(lengths)
        if np.any(lengths <= 0) or len(content) != lengths.sum():
            raise StateError(f"window: {len(content)} strides in {len(lengths)} blocks cannot be")
        self._empty()
        for start, end in zip((ends - lengths).tolist(), ends.tolist(), strict=True):
            self._count(self._place(content[start:end].cells))
        self._content, self._begins, self._lengths = [content], content.t[ends - lengths], lengths
        self.added, self.evicted = read(state, "added", Count), read(state, "evicted", Count)
        if len(self) > self._capacity:
            raise StateError(f"window: {len(self)} rows where {self._capacity} are the most")

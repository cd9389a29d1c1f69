"""A bounded window of admitted samples: blocks of consecutive driving; those in rare cells are kept longest."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from estimator.checkpoint.validation import Count, State, array, read, substate
from estimator.config import Config
from estimator.errors import StateError
from estimator.signals import Floats

MIN_ACCELERATION = -1.0  # m/s^2, where the grid of cells begins; lower values fall into its first cells
SPEED_CELLS = 64  # of `gate.speed_step_m_s`: up to 160 m/s by default
ACCELERATION_CELLS = 64  # of `gate.acceleration_step_m_s2`: up to 5.4 m/s^2 by default


@dataclass(frozen=True)
class Grid:
    """Cells of speed x acceleration, numbered row by row; values beyond the last cell fall into it."""

    speed_step: float  # [m/s]
    acceleration_step: float  # [m/s^2]

    size = SPEED_CELLS * ACCELERATION_CELLS

    def cell(self, v: Floats, a: Floats) -> NDArray[np.int64]:
        """Cell number (n,) of each speed [m/s] and acceleration [m/s^2]."""
        row = np.clip(np.floor(v / self.speed_step), 0, SPEED_CELLS - 1)
        column = np.floor((a - MIN_ACCELERATION) / self.acceleration_step)
        cell: NDArray[np.int64] = (row * ACCELERATION_CELLS + np.clip(column, 0, ACCELERATION_CELLS - 1)).astype(
            np.int64
        )
        return cell

    def centres(self) -> tuple[Floats, Floats]:
        """Speed [m/s] and acceleration [m/s^2] in the middle of every cell (size,)."""
        row, column = np.divmod(np.arange(self.size), ACCELERATION_CELLS)
        return (row + 0.5) * self.speed_step, MIN_ACCELERATION + (column + 0.5) * self.acceleration_step


@dataclass(frozen=True)
class Cells:
    """Cells of a block's elements, and how many rows each stands for."""

    places: NDArray[np.int64]
    rows: NDArray[np.int64]


class Content(Protocol):
    """What a window can hold: `Samples` or `Strides`."""

    def __len__(self) -> int: ...

    def __getitem__(self, part: slice) -> Self: ...

    @property
    def t(self) -> Floats:
        """Times [s] (n,), ascending."""
        ...

    @property
    def cells(self) -> tuple[Floats, Floats, NDArray[np.int64]]:
        """Speed [m/s], acceleration [m/s^2] and number of rows (n,) of each element, by which cells are counted."""
        ...

    @property
    def own_cells(self) -> tuple[Floats, Floats, NDArray[np.int64]]:
        """The same by measured values, for plots."""
        ...

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads."""
        ...

    @classmethod
    def restore(cls, state: State) -> Self:
        """Content from its state."""
        ...

    @classmethod
    def concatenate(cls, parts: list[Self]) -> Self:
        """Join in order."""
        ...


C = TypeVar("C", bound=Content)


class Window(Generic[C]):
    """Holds at most ``config.window.samples`` rows, none older than ``config.window.hours``.

    When it is full, the block whose rows lie in the fullest cells goes first, so hours of cruising do not push out
    the few accelerations that identify the mass.

    Parameters
    ----------
    config
        All settings.
    kind
        Class of its content.
    """

    def __init__(self, config: Config, kind: type[C]) -> None:
        self.grid = Grid(config.gate.speed_step_m_s, config.gate.acceleration_step_m_s2)
        self.evicted = 0  # rows
        self.added = 0  # rows ever admitted
        self._kind = kind
        self._capacity = config.window.samples
        self._longest = config.window.hours * 3600.0
        self._blocks: dict[int, C] = {}  # by number, in the order of time
        self._cells: dict[int, Cells] = {}
        self._numbered = 0
        self._counts = np.zeros(self.grid.size, dtype=np.int64)  # rows

    def __len__(self) -> int:
        return int(self._counts.sum())

    @property
    def samples(self) -> C:
        """Everything in the window, oldest first."""
        return self._kind.concatenate(list(self._blocks.values()))

    @property
    def blocks(self) -> Mapping[int, C]:
        """The same in blocks, each under a number that no other block ever has."""
        return self._blocks

    @property
    def counts(self) -> NDArray[np.int64]:
        """Rows per cell of their own speed and acceleration (grid.size,)."""
        return self._counted(self._place(self.samples.own_cells))

    def add(self, block: C) -> None:
        """Add a block of consecutive driving, and evict blocks beyond the capacity or the age limit."""
        if not len(block):
            return
        cells = self._place(block.cells)
        self._blocks[self._numbered], self._cells[self._numbered] = block, cells
        self._numbered += len(block)
        self._counts += self._counted(cells)
        self.added += int(cells.rows.sum())
        while self._blocks and block.t[-1] - self._blocks[oldest := min(self._blocks)].t[0] > self._longest:
            self._drop(oldest)
        while len(self) > self._capacity:
            self._drop(max(self._cells, key=self._fullness))

    def _fullness(self, number: int) -> float:
        """Mean count of the cells of a block's rows; 0 for a block without cells, which is evicted last."""
        cells = self._cells[number]
        total = int(cells.rows.sum())
        return float((self._counts[cells.places] * cells.rows).sum()) / total if total else 0.0

    def _place(self, cells: tuple[Floats, Floats, NDArray[np.int64]]) -> Cells:
        speed, acceleration, rows = cells
        return Cells(self.grid.cell(speed, acceleration), rows)

    def _counted(self, cells: Cells) -> NDArray[np.int64]:
        counted = np.bincount(cells.places, cells.rows, minlength=self.grid.size)
        return counted.astype(np.int64)

    def _drop(self, number: int) -> None:
        self.evicted += self._remove(number)

    def _remove(self, number: int) -> int:
        """Take a block away, and return its rows."""
        self._blocks.pop(number)
        cells = self._cells.pop(number)
        self._counts -= self._counted(cells)
        return int(cells.rows.sum())

    def forget_before(self, t: float) -> None:
        """Forget the blocks that end before time ``t`` [s]."""
        for number in [number for number, block in self._blocks.items() if block.t[-1] < t]:
            self._remove(number)

    def clear(self) -> None:
        """Forget everything, as after a change of vehicle or an unexplained step in time."""
        self._blocks, self._cells = {}, {}
        self._counts[:] = 0

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads."""
        lengths = np.array([len(block) for block in self._blocks.values()], dtype=np.int64)
        return {
            "samples": self.samples.state(),
            "lengths": lengths,
            "numbers": np.array(list(self._blocks), dtype=np.int64),
            "numbered": self._numbered,
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
        samples, lengths = self._kind.restore(substate(state, "samples")), array(state, "lengths", (-1,), np.int64)
        numbers = array(state, "numbers", (len(lengths),), np.int64)
        ends = np.cumsum(lengths)
        if np.any(lengths <= 0) or len(samples) != lengths.sum() or np.any(np.diff(numbers) < lengths[:-1]):
            raise StateError(f"window: {len(samples)} samples in {len(lengths)} blocks cannot be")
        self.added, self.evicted = read(state, "added", Count), read(state, "evicted", Count)
        self._numbered = read(state, "numbered", Count)
        if len(numbers) and (numbers[0] < 0 or numbers[-1] + lengths[-1] > self._numbered):
            raise StateError("window: numbers of blocks are out of range")
        slices = [slice(end - length, end) for end, length in zip(ends.tolist(), lengths.tolist(), strict=True)]
        self._blocks = {number: samples[part] for number, part in zip(numbers.tolist(), slices, strict=True)}
        self._cells = {number: self._place(block.cells) for number, block in self._blocks.items()}
        self._counts = self._counted(self._place(samples.cells))
        if len(self) > self._capacity:
            raise StateError(f"window: {len(self)} rows where {self._capacity} are the most")

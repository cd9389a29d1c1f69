"""From rows to the input of a model: the part of the estimator that depends on the likelihood.

`SampleStage` makes samples with instruments, ten a second, for the moments and the paper's likelihood; `StrideStage`
makes strides, one a second, for the model with the road as a state. Both cut at fixed rows, independent of the batches.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from estimator.checkpoint.validation import Count, State, optional, read, substate
from estimator.config import Config
from estimator.errors import StateError
from estimator.model.design_matrix import wanted_by
from estimator.model.effects import Effect, named
from estimator.preparation import kinematics, smoothing
from estimator.preparation.admission import Reason
from estimator.preparation.lag import MAX_LAG
from estimator.preparation.sample_maker import SampleMaker
from estimator.preparation.standstill import Standstill
from estimator.preparation.striding import Strider
from estimator.samples import Rows, Samples
from estimator.signals import Quantity
from estimator.strides import Strides

BLOCK_ROWS = 200  # rows turned into samples or strides at a time: 20 s
CALIBRATION_ROWS = 1800  # moving rows from which noise and lag of the signals are found: 3 min
MAX_WAITING_ROWS = 18_000  # rows, 30 min: after so many that wait, fewer moving rows are used; bounds the memory
MIN_KNOWN_SHARE = 0.05  # of the first minutes, in which a quantity must be known to be used

B = TypeVar("B", Samples, Strides, covariant=True)


@dataclass(frozen=True)
class Piece(Generic[B]):
    """``rows`` of the grid and the ``block`` made of them; ``departs`` where they begin a load segment."""

    rows: Rows
    block: B
    departs: bool


class Stage(Protocol[B]):
    """Turns rows into pieces; see the module."""

    rejected: Counter[str]
    moving: int  # rows in motion
    lag: float  # by which power was moved [s]
    wanted: frozenset[Quantity] | None  # context of the pieces, None before it is known

    def feed(self, rows: Rows) -> Iterator[Piece[B]]:
        """Take the next rows, which follow those before without a gap."""
        ...

    def finish(self) -> Iterator[Piece[B]]:
        """Use the rows that still wait, at the end of a log or before a gap."""
        ...

    @property
    def waiting(self) -> float | None:
        """Time of the newest row that waits or was turned into pieces since the last `finish` [s]; None if none."""
        ...

    def pause(self, rows: int) -> None:
        """Count ``rows`` of the grid that are missing: a silence of the bus."""
        ...

    def forget(self, vehicle: bool) -> None:
        """Start a new drive; with ``vehicle`` perhaps of another one."""
        ...

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads."""
        ...

    def restore(self, state: State) -> None:
        """Take the state of another stage."""
        ...


def _needed(effects: tuple[Effect, ...], rows: Rows) -> frozenset[Quantity]:
    """Quantities that the effects need and that the bus carries in ``rows``."""
    if not effects:
        return frozenset()
    there = kinematics.quantities(rows, 0.0).items()
    return wanted_by(effects, {q for q, values in there if np.isfinite(values).mean() > MIN_KNOWN_SHARE})


class SampleStage:
    """Rows to samples: smoothed by a filter whose noise levels, like the lag, are found in the first minutes."""

    def __init__(self, config: Config) -> None:
        self.rejected: Counter[str] = Counter()
        self.moving = 0
        self._heard = 0  # moving rows since the drive began
        self.lag = 0.0
        self.wanted: frozenset[Quantity] | None = None
        self._config = config
        self._effects = named(config.effects)
        self._maker = SampleMaker(config.kinematics, config.admission)
        self._pending: Rows | None = None
        self._smoother: smoothing.Kernels | None = None
        self._start: float | None = None  # [s] of the drive
        self._standstill = Standstill(config.load, config.admission.minimum_speed_m_s)

    @property
    def waiting(self) -> float | None:
        """See `Stage`."""
        return None if self._pending is None else float(self._pending.t[-1])

    def feed(self, rows: Rows) -> Iterator[Piece[Samples]]:
        """See `Stage`."""
        self._pending = rows if self._pending is None else Rows.concatenate(self._pending, rows)
        moving = int((rows.speed > self._config.admission.minimum_speed_m_s).sum())
        self.moving, self._heard = self.moving + moving, self._heard + moving
        is_unheard = bool(self._effects) and self.wanted is None and self._heard < CALIBRATION_ROWS
        if (self.moving < CALIBRATION_ROWS or is_unheard) and len(self._pending) < MAX_WAITING_ROWS:
            return
        yield from self._consume(BLOCK_ROWS)

    def finish(self) -> Iterator[Piece[Samples]]:
        """See `Stage`; the rows at the very ends have no complete surroundings."""
        if self._pending is None:
            return
        yield from self._consume(1)
        self._standstill.pause(len(self._pending))  # neither these nor the first rows were in a piece
        self.rejected[Reason.INCOMPLETE] += len(self._pending)
        self._pending = None

    def pause(self, rows: int) -> None:
        """See `Stage`."""
        self._standstill.pause(rows)

    def forget(self, vehicle: bool) -> None:
        """See `Stage`; another vehicle has another lag."""
        self._pending, self.wanted, self._start, self._heard = None, None, None, 0
        if vehicle:
            self._smoother, self.lag, self.moving = None, 0.0, 0

    def _consume(self, least: int) -> Iterator[Piece[Samples]]:
        assert self._pending is not None
        margin = self._maker.margin
        if self._smoother is None:
            self._smoother, self.lag = self._maker.calibrate(self._pending.plausible_speed, self._pending.power)
        if self.wanted is None:
            self._start = float(self._pending.t[0])
            self.wanted = _needed(self._effects, self._pending)
        while len(self._pending) >= least + 2 * margin:
            core = min(BLOCK_ROWS, len(self._pending) - 2 * margin)
            yield self._piece(self._pending[: core + 2 * margin])
            self._pending = self._pending[core:]
        if self.moving < CALIBRATION_ROWS:
            # The smoother is kept for the whole drive, so it is not calibrated on a few seconds of driving.
            self._smoother, self.moving = None, 0

    def _piece(self, rows: Rows) -> Piece[Samples]:
        assert self._smoother is not None
        assert self.wanted is not None
        assert self._start is not None
        samples = self._maker.samples(rows, self._smoother, self.lag, self.wanted, self._start)
        core = self._maker.core(rows)
        departs = self._standstill.departure(core.speed) is not None
        return Piece(core, self._maker.admit(samples, rows, self.rejected), departs)

    def state(self) -> dict[str, Any]:
        """See `Stage`."""
        return {
            "rejected": dict(self.rejected),
            "pending": None if self._pending is None else self._pending.state(),
            "smoother": None if self._smoother is None else self._smoother.state(),
            "lag": self.lag,
            "wanted": None if self.wanted is None else sorted(self.wanted),
            "start": self._start,
            "moving": self.moving,
            "heard": self._heard,
            "standstill": self._standstill.state(),
        }

    def restore(self, state: State) -> None:
        """See `Stage`.

        Raises
        ------
        StateError
            The state is not that of such a stage.
        """
        self.rejected = Counter(read(state, "rejected", dict[str, Count]))
        self._pending = optional(state, "pending", Rows.restore)
        self._heard = read(state, "heard", Count)
        self._smoother = optional(state, "smoother", smoothing.Kernels.restore)
        self.lag, self.moving = read(state, "lag", float), read(state, "moving", Count)
        wanted = read(state, "wanted", list[Quantity] | None)
        self.wanted, self._start = None if wanted is None else frozenset(wanted), read(state, "start", float | None)
        self._standstill.restore(substate(state, "standstill"))
        if abs(self.lag) > MAX_LAG:
            raise StateError("lag: is out of range")
        if (self.wanted is None) != (self._start is None):
            raise StateError("start: does not match the wanted context")


class StrideStage:
    """Rows to strides; with effects it waits until the signals that the bus carries for them are known."""

    lag = 0.0  # strides hold the force at several lags

    def __init__(self, config: Config) -> None:
        self.rejected: Counter[str] = Counter()
        self.moving = 0
        self._heard = 0  # moving rows since the drive began
        self.wanted: frozenset[Quantity] | None = None
        self._config = config
        self._effects = tuple(effect for effect in named(config.effects) if not effect.is_gravity)
        self._pending: Rows | None = None  # not yet strided
        self._strider: Strider | None = None
        self._newest: float | None = None
        self._standstill = Standstill(config.load, config.admission.minimum_speed_m_s)

    @property
    def waiting(self) -> float | None:
        """See `Stage`."""
        return self._newest

    def feed(self, rows: Rows) -> Iterator[Piece[Strides]]:
        """See `Stage`."""
        self._pending = rows if self._pending is None else Rows.concatenate(self._pending, rows)
        self._newest = float(rows.t[-1])
        moving = int((rows.speed > self._config.admission.minimum_speed_m_s).sum())
        self.moving, self._heard = self.moving + moving, self._heard + moving
        is_unheard = bool(self._effects) and self.wanted is None and self._heard < CALIBRATION_ROWS
        if is_unheard and len(self._pending) < MAX_WAITING_ROWS:
            return
        self._begin()
        while self._pending is not None and len(self._pending) >= BLOCK_ROWS:
            part, self._pending = self._pending[:BLOCK_ROWS], self._pending[BLOCK_ROWS:]
            yield from self._stride(part)

    def finish(self) -> Iterator[Piece[Strides]]:
        """See `Stage`."""
        if self._newest is None:
            return
        self._begin()
        assert self._strider is not None
        if self._pending is not None and len(self._pending):
            yield from self._stride(self._pending)
        self._pending, self._newest = None, None
        yield from self._last()
        self._strider.pause()

    def pause(self, rows: int) -> None:
        """See `Stage`."""
        self._standstill.pause(rows)

    def forget(self, vehicle: bool) -> None:
        """See `Stage`."""
        self._pending, self._strider, self.wanted, self._newest, self._heard = None, None, None, None, 0

    def _begin(self) -> None:
        if self._strider is None:
            assert self._pending is not None
            self.wanted = _needed(self._effects, self._pending)
            self._strider = Strider(self._config.admission, self.wanted, float(self._pending.t[0]))

    def _stride(self, rows: Rows) -> Iterator[Piece[Strides]]:
        """Pieces of strides, separated at a departure, after which the load may differ."""
        assert self._strider is not None
        departure = self._standstill.departure(rows.speed)
        if departure is not None:
            if departure:
                yield Piece(rows[:departure], self._strider.feed(rows[:departure], self.rejected), False)
            yield from self._last()
            rows = rows[departure:]
        yield Piece(rows, self._strider.feed(rows, self.rejected), departure is not None)

    def _last(self) -> Iterator[Piece[Strides]]:
        """The strides that the strider still holds; their rows were counted before."""
        assert self._strider is not None
        held = self._strider.held
        if held is not None:
            yield Piece(held[:0], self._strider.finish(self.rejected), False)

    def state(self) -> dict[str, Any]:
        """See `Stage`."""
        return {
            "rejected": dict(self.rejected),
            "pending": None if self._pending is None or not len(self._pending) else self._pending.state(),
            "strider": None if self._strider is None else self._strider.state(),
            "newest": self._newest,
            "moving": self.moving,
            "heard": self._heard,
            "standstill": self._standstill.state(),
        }

    def restore(self, state: State) -> None:
        """See `Stage`.

        Raises
        ------
        StateError
            The state is not that of such a stage.
        """
        self.rejected = Counter(read(state, "rejected", dict[str, Count]))
        self._pending = optional(state, "pending", Rows.restore)
        found = read(state, "strider", dict[str, Any] | None)
        self._strider = None if found is None else Strider.restore(self._config.admission, found)
        self.wanted = None if self._strider is None else self._strider.wanted
        self._newest, self.moving = read(state, "newest", float | None), read(state, "moving", Count)
        self._heard = read(state, "heard", Count)
        self._standstill.restore(substate(state, "standstill"))

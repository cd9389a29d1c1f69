"""Incremental conversion of rows to strides, cut at fixed rows and at departures, whatever the batches are."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from estimator.checkpoint.validation import Count, State, optional, read, substate
from estimator.config import Config
from estimator.errors import StateError
from estimator.model.effect_term import wanted_by
from estimator.model.effects import Effect, named, unbound
from estimator.preparation.context import quantities_of
from estimator.preparation.standstill import Standstill
from estimator.preparation.striding import Strider
from estimator.samples import Rows
from estimator.signals import Quantity
from estimator.strides import Strides

BLOCK_ROWS = 200  # rows turned into strides at a time: 20 s
LISTENING_ROWS = 1800  # moving rows after which the signals of the bus are known: 3 min
MAX_WAITING_ROWS = 18_000  # rows, 30 min: after so many that wait, fewer moving rows are used; bounds the memory
MIN_KNOWN_SHARE = 0.05  # of the first minutes, in which a quantity must be known to be used


@dataclass(frozen=True)
class Piece:
    """``rows`` of the grid and the ``strides`` made of them; ``departs`` is True if they begin a load segment."""

    rows: Rows
    strides: Strides
    departs: bool


def moving_effects(config: Config) -> tuple[Effect, ...]:
    """Effects other than gravity: those of the configuration, and those of the unbound parts of the torque."""
    asked = tuple(effect for effect in named(config.effects) if not effect.is_gravity)
    return asked + tuple(unbound(config.binding.keys()).values())


def _needed(effects: tuple[Effect, ...], rows: Rows) -> frozenset[Quantity]:
    """Quantities that the effects need and that the bus carries in ``rows``."""
    if not effects:
        return frozenset()
    quantities = quantities_of(rows, 0.0).items()
    return wanted_by(effects, {q for q, values in quantities if np.isfinite(values).mean() > MIN_KNOWN_SHARE})


class StrideStage:
    """Turns rows into strides; with effects, it waits until it is known which of their signals the bus carries.

    Attributes
    ----------
    rejected : Counter
        Rows in no stride of known force, by reason.
    moving : int
        Rows in motion.
    wanted : frozenset or None
        Context of the strides, None before it is known.
    standstill : Standstill
        The present stop, by the newest row.
    departures : list[int]
        Indices of rows that wait for their piece, and with which a load segment begins.
    """

    def __init__(self, config: Config) -> None:
        self.rejected: Counter[str] = Counter()
        self.moving = 0
        self._heard = 0  # moving rows since the drive began
        self.wanted: frozenset[Quantity] | None = None
        self._config = config
        self._effects = moving_effects(config)
        self._pending: Rows | None = None  # not yet strided
        self._strider: Strider | None = None
        self._newest: float | None = None
        self.standstill = Standstill(config.load, config.admission.minimum_speed_m_s)
        self.departures: list[int] = []

    @property
    def waiting(self) -> float | None:
        """Time [s] of the newest row since the last `finish`; None if none."""
        return self._newest

    def feed(self, rows: Rows) -> Iterator[Piece]:
        """Take the next rows, which follow the previous ones without a gap."""
        self._pending = rows if self._pending is None else Rows.concatenate(self._pending, rows)
        begun = (int(rows.index[i]) for i in self.standstill.departures(rows.speed))
        self.departures = [*self.departures, *begun]
        self._newest = float(rows.t[-1])
        moving = int((rows.speed > self._config.admission.minimum_speed_m_s).sum())
        self.moving, self._heard = self.moving + moving, self._heard + moving
        is_unheard = bool(self._effects) and self.wanted is None and self._heard < LISTENING_ROWS
        if is_unheard and len(self._pending) < MAX_WAITING_ROWS:
            return
        self._begin()
        while self._pending is not None and len(self._pending) >= BLOCK_ROWS:
            part, self._pending = self._pending[:BLOCK_ROWS], self._pending[BLOCK_ROWS:]
            yield from self._stride(part)

    def finish(self) -> Iterator[Piece]:
        """Process the waiting rows, at the end of a log or before a gap."""
        if self._newest is None:
            return
        self._begin()
        assert self._strider is not None
        if self._pending is not None and len(self._pending):
            yield from self._stride(self._pending)
        self._pending, self._newest = None, None
        yield from self._held_strides()
        self._strider.pause()

    def pause(self, rows: int) -> None:
        """Count ``rows`` missing rows of the grid, in a silence of the bus, as standing."""
        self.standstill.pause(rows)

    def forget(self) -> None:
        """Start a new drive."""
        self.departures = []
        self._pending, self._strider, self.wanted, self._newest, self._heard = None, None, None, None, 0

    def _begin(self) -> None:
        if self._strider is None:
            assert self._pending is not None
            self.wanted = _needed(self._effects, self._pending)
            self._strider = Strider(self._config.admission, self.wanted, float(self._pending.t[0]))

    def _stride(self, rows: Rows) -> Iterator[Piece]:
        """Yield pieces of strides, cut at the last departure, after which the load may differ."""
        assert self._strider is not None
        passed = [index for index in self.departures if index <= rows.index[-1]]
        departure = passed[-1] - int(rows.index[0]) if passed else None
        self.departures = self.departures[len(passed) :]
        if departure is not None:
            if departure:
                yield Piece(rows[:departure], self._strider.feed(rows[:departure], self.rejected), False)
            yield from self._held_strides()
            rows = rows[departure:]
        yield Piece(rows, self._strider.feed(rows, self.rejected), departure is not None)

    def _held_strides(self) -> Iterator[Piece]:
        """Yield the strides that the strider still holds; their rows belong to earlier pieces."""
        assert self._strider is not None
        held = self._strider.waiting_rows
        if held is not None:
            yield Piece(held[:0], self._strider.finish(self.rejected), False)

    def state(self) -> dict[str, Any]:
        """State for `restore`."""
        return {
            "rejected": dict(self.rejected),
            "pending": None if self._pending is None or not len(self._pending) else self._pending.state(),
            "strider": None if self._strider is None else self._strider.state(),
            "newest": self._newest,
            "moving": self.moving,
            "heard": self._heard,
            "standstill": self.standstill.state(),
            "departures": self.departures,
        }

    def restore(self, state: State) -> None:
        """Take the state of another stage.

        Raises
        ------
        StateError
            The state is not that of such a stage.
        """
        self.rejected = Counter(read(state, "rejected", dict[str, Count]))
        self._pending = optional(state, "pending", Rows.restore)
        strider_state = read(state, "strider", dict[str, Any] | None)
        self._strider = None if strider_state is None else Strider.restore(self._config.admission, strider_state)
        self.wanted = None if self._strider is None else self._strider.wanted
        self._newest, self.moving = read(state, "newest", float | None), read(state, "moving", Count)
        self._heard = read(state, "heard", Count)
        self.standstill.restore(substate(state, "standstill"))
        self.departures = read(state, "departures", list[int])
        waiting = () if self._pending is None else self._pending.index.tolist()
        if [index for index in waiting if index in self.departures] != self.departures:
            raise StateError("departures: are not of rows that wait")

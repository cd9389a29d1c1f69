"""Rows of the time grid: what was on the bus, ten times a second."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from estimator.checkpoint.validation import State, array, names, substate, table
from estimator.errors import StateError
from estimator.signals import Floats, Mask, Quantity, Role

STEP = 0.1  # s, the time grid: wheel speed comes at 10 Hz on nearly every bus
MAX_ACCELERATION = 12.0  # m/s^2, beyond the grip of any tyre: a faster change is an error of the speed signal

K = TypeVar("K")


@dataclass(frozen=True, slots=True, kw_only=True)
class Rows:
    """Signals on the time grid, oldest first; all arrays (n,), NaN where a signal is stale or not available.

    ``index`` counts steps of STEP since time zero; ``speed`` [m/s]; ``power`` [W] at the wheels; ``context`` holds
    the other bound roles in SI; ``fresh`` says for speed and power (n, 2) whether a reading was there at all;
    ``derived`` holds what does not follow from the row alone: from the rows before, or from a map.
    """

    index: NDArray[np.int64]
    speed: Floats
    power: Floats
    fresh: Mask
    context: Mapping[Role, Floats]
    derived: Mapping[Quantity, Floats] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, part: slice) -> "Rows":
        return Rows(
            index=self.index[part],
            speed=self.speed[part],
            power=self.power[part],
            fresh=self.fresh[part],
            context={role: values[part] for role, values in self.context.items()},
            derived={quantity: values[part] for quantity, values in self.derived.items()},
        )

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads."""
        return table(self)

    @classmethod
    def restore(cls, state: State) -> "Rows":
        """Rows from their state.

        Raises
        ------
        StateError
            It is not that of consecutive rows.
        """
        index = array(state, "index", (-1,), np.int64)
        n, context, derived = len(index), substate(state, "context"), substate(state, "derived")
        if not n or np.any(np.diff(index) != 1):
            raise StateError("rows: are none, or have gaps")
        return cls(
            index=index,
            speed=array(state, "speed", (n,), finite=False),
            power=array(state, "power", (n,), finite=False),
            fresh=array(state, "fresh", (n, 2), np.bool_),
            context={role: array(context, role, (n,), finite=False) for role in names(context, Role)},
            derived={quantity: array(derived, quantity, (n,), finite=False) for quantity in names(derived, Quantity)},
        )

    @property
    def t(self) -> Floats:
        """Grid times [s] (n,)."""
        return self.index * STEP

    @property
    def frozen(self) -> Mask:
        """Where speed and power no longer change on the move (n,): last values are repeated."""
        if Quantity.FROZEN not in self.derived:
            return np.zeros(len(self), dtype=bool)
        is_frozen: Mask = self.derived[Quantity.FROZEN] == 1.0
        return is_frozen

    @property
    def plausible_speed(self) -> Floats:
        """Speed [m/s] (n,), NaN where frozen and on either side of a jump: a locked wheel, a restarted sensor.

        One such value has more weight in the fit than an hour of driving, and its cell is evicted last.
        """
        jump = np.abs(np.diff(self.speed)) > MAX_ACCELERATION * STEP
        wrong = np.append(jump, False) | np.insert(jump, 0, False) | self.frozen
        return np.where(wrong, np.nan, self.speed)

    @classmethod
    def concatenate(cls, *parts: "Rows") -> "Rows":
        """The parts in order; what only some of them have is NaN in the others."""
        return cls(
            index=np.concatenate([part.index for part in parts]),
            speed=np.concatenate([part.speed for part in parts]),
            power=np.concatenate([part.power for part in parts]),
            fresh=np.concatenate([part.fresh for part in parts]),
            context=_joined([(part.context, len(part)) for part in parts]),
            derived=_joined([(part.derived, len(part)) for part in parts]),
        )


def mean_density(density: Floats) -> float:
    """Mean of the known values of a density (n,); 1 where none is."""
    known = np.isfinite(density)
    return float(density[known].mean()) if known.any() else 1.0


def over_mean(density: Floats, mean: float | None = None) -> Floats:
    """A density (n,) over a ``mean`` [1], by default its own; 1 where it is not known."""
    mean = mean_density(density) if mean is None else mean
    return np.where(np.isfinite(density), density / mean, 1.0)


def _joined(parts: Sequence[tuple[Mapping[K, Floats], int]]) -> dict[K, Floats]:
    """Columns of parts, each with its length, one after another: NaN in a part that lacks the column."""
    keys = dict.fromkeys(key for columns, _ in parts for key in columns)
    return {
        key: np.concatenate([columns[key] if key in columns else np.full(n, np.nan) for columns, n in parts])
        for key in keys
    }

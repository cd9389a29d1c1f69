"""The arrays that the estimator hands on: rows of the time grid, and admitted samples."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
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
        is_frozen: Mask = self.derived.get(Quantity.FROZEN, np.zeros(len(self))) == 1.0
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


def over_mean(density: Floats) -> Floats:
    """A density (n,) over its mean [1]; 1 where it is not known."""
    known = np.isfinite(density)
    mean = density[known].mean() if known.any() else 1.0
    return np.where(known, density / mean, 1.0)


def _joined(parts: Sequence[tuple[Mapping[K, Floats], int]]) -> dict[K, Floats]:
    """Columns of parts, each with its length, one after another: NaN in a part that lacks the column."""
    keys = dict.fromkeys(key for columns, _ in parts for key in columns)
    return {key: np.concatenate([columns.get(key, np.full(n, np.nan)) for columns, n in parts]) for key in keys}


@dataclass(frozen=True, slots=True, kw_only=True)
class Samples:
    """Samples that the model is fitted to; all arrays (n,).

    Smoothed speed ``v`` [m/s], acceleration ``a`` [m/s^2] and power ``P`` [W] with its rate ``dP`` [W/s]; and their
    instruments ``zv``, ``za``, ``zdP``: the same quantities from readings around, but not at, the moment.
    ``density`` of the air [kg/m^3], NaN where temperature or pressure is not known. ``context`` holds what effects
    beyond the plain road load are computed from; blocks that are joined have the same.
    """

    t: Floats
    v: Floats
    a: Floats
    P: Floats
    dP: Floats
    zv: Floats
    za: Floats
    zdP: Floats
    density: Floats
    context: Mapping[Quantity, Floats] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.t)

    @property
    def complete(self) -> Mask:
        """Whether all quantities of the model are known (n,); the density may be missing."""
        needed = [values for name, values in self._arrays().items() if name != "density"]
        known: Mask = np.all(np.isfinite([*needed, *self.context.values()]), axis=0)
        return known

    @property
    def cells(self) -> tuple[Floats, Floats, NDArray[np.int64]]:
        """Speed [m/s], acceleration [m/s^2] and rows (n,) of each sample, by its instruments.

        The window keeps rare accelerations longest. Selected by measured acceleration, it would keep samples with large
        noise; the noise of the instruments is independent of it.
        """
        return self.zv, self.za, np.ones(len(self), dtype=np.int64)

    @property
    def own_cells(self) -> tuple[Floats, Floats, NDArray[np.int64]]:
        """Speed [m/s], acceleration [m/s^2] and rows (n,) of each sample, as measured."""
        return self.v, self.a, np.ones(len(self), dtype=np.int64)

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads."""
        return table(self)

    @classmethod
    def restore(cls, state: State) -> "Samples":
        """Samples from their state.

        Raises
        ------
        StateError
            It is not that of samples, or not one that the model could use.
        """
        n, context = len(array(state, "t", (-1,))), substate(state, "context")
        plain = [each.name for each in fields(cls) if each.name != "context"]
        columns: dict[str, Any] = {name: array(state, name, (n,), finite=False) for name in plain}
        columns["context"] = {quantity: array(context, quantity, (n,)) for quantity in names(context, Quantity)}
        samples = cls(**columns)
        if not samples.complete.all():
            raise StateError("samples: are not all complete")
        return samples

    def _arrays(self) -> dict[str, Any]:
        return {each.name: getattr(self, each.name) for each in fields(self) if each.name != "context"}

    @property
    def relative_density(self) -> Floats:
        """Density (n,) of the air over its mean here [1]; 1 where it is not known."""
        return over_mean(self.density)

    def __getitem__(self, part: slice | Mask | NDArray[np.intp]) -> "Samples":
        context = {quantity: values[part] for quantity, values in self.context.items()}
        return Samples(**{name: values[part] for name, values in self._arrays().items()}, context=context)

    @classmethod
    def concatenate(cls, parts: "list[Samples]") -> "Samples":
        """Join in order; no parts give no samples."""
        if not parts:
            blank: dict[str, Any] = {each.name: np.empty(0) for each in fields(cls) if each.name != "context"}
            return cls(**blank)
        columns: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts]) for name in parts[0]._arrays()
        }
        context = {
            quantity: np.concatenate([part.context[quantity] for part in parts]) for quantity in parts[0].context
        }
        return cls(**columns, context=context)

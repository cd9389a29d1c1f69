"""Strides: the equation of motion averaged over one second each, which the road model is fitted to.

A stride runs from one speed to the next, each the mean over EDGE rows. The change between two such means is the
acceleration weighted with a trapezoid (a box of a stride's length convolved with a box of EDGE rows), so every other
quantity is averaged with exactly these weights: one low-pass for all columns, and no differentiation of noise.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.checkpoint.validation import State, array, names, substate, table
from estimator.errors import StateError
from estimator.samples import STEP, over_mean
from estimator.signals import Floats, Mask, Quantity

ROWS = 10  # of the time grid in a stride: 1 s
EDGE = 3  # rows whose mean is the speed at either end
DURATION = ROWS * STEP  # s
LAGS = np.round(np.arange(-6, 7, 2) * STEP, 10)  # s by which the power is taken later


@dataclass(frozen=True, slots=True, kw_only=True)
class Strides:
    """Strides in order of time; all arrays (n,) but ``force``, which is (n, len(LAGS)).

    ``t`` [s] of the middle; ``rows`` of the time grid that it stands for; ``v0``, ``v1`` [m/s] and ``s0``, ``s1`` [m]
    speed and distance at the ends; ``a`` [m/s^2] between them; ``speed_squared`` [m^2/s^2]; ``force`` [N] of the
    engine at the wheels with its power taken later by each of LAGS; ``gearing`` [rad/m] turns of the engine per
    distance; ``density`` of the air [kg/m^3]. Of the road: ``altitude`` [m],
    ``grade`` sine of the slope and ``grade_offset_sd`` of its constant error, where that is known, ``gravity`` [m/s^2]
    along the road by an accelerometer. What is not known is NaN.
    ``known`` where the force is known throughout; only there do a and force count. ``context`` holds what
    effects are computed from.
    """

    t: Floats
    rows: NDArray[np.int64]
    known: Mask
    v0: Floats
    v1: Floats
    s0: Floats
    s1: Floats
    a: Floats
    speed_squared: Floats
    force: Floats
    gearing: Floats
    density: Floats
    altitude: Floats
    grade: Floats
    grade_offset_sd: Floats
    gravity: Floats
    context: Mapping[Quantity, Floats] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.t)

    @property
    def speed(self) -> Floats:
        """Mean of the speeds at both ends [m/s] (n,)."""
        return 0.5 * (self.v0 + self.v1)

    @property
    def usual_turns(self) -> float:
        """Median of the known engine speeds [rad/s]; 1 where none is."""
        turns = self.gearing * self.speed
        there = np.isfinite(turns)
        return float(np.median(turns[there])) if there.any() else 1.0

    def filled_gearing(self, turns: float) -> Floats:
        """Gearing [rad/m] (n,), by the engine speed ``turns`` [rad/s] where the engine's is not known."""
        return np.where(np.isfinite(self.gearing * self.speed), self.gearing, turns / self.speed)

    @property
    def power(self) -> Floats:
        """Power [W] (n,) at the wheels, without a shift in time."""
        return self.force[:, len(LAGS) // 2] * self.speed

    @property
    def joined(self) -> Mask:
        """Whether a known stride begins where a known stride before it ended (n,), so that they share that speed."""
        follows = np.zeros(len(self), dtype=bool)
        follows[1:] = (np.abs(np.diff(self.t) - DURATION) < STEP / 2) & self.known[1:] & self.known[:-1]
        return follows

    @property
    def cells(self) -> tuple[Floats, Floats, NDArray[np.int64]]:
        """Speed [m/s], acceleration [m/s^2] and rows (n,) of each stride whose force is known."""
        return self.speed[self.known], self.a[self.known], self.rows[self.known]

    @property
    def relative_density(self) -> Floats:
        """Density (n,) of the air over its mean here [1]; 1 where it is not known."""
        return over_mean(self.density)

    def without(self, signals: Sequence[str]) -> "Strides":
        """Copy in which these ``signals`` of the road have no values."""
        blank: dict[str, Any] = dict.fromkeys(signals, np.full(len(self), np.nan))
        return replace(self, **blank)

    def __getitem__(self, part: slice | Mask | NDArray[np.intp]) -> "Strides":
        context = {quantity: values[part] for quantity, values in self.context.items()}
        plain = {each.name: getattr(self, each.name)[part] for each in fields(self) if each.name != "context"}
        return Strides(**plain, context=context)

    @classmethod
    def concatenate(cls, parts: "list[Strides]") -> "Strides":
        """Join in order; a quantity that only some parts have is NaN in the others."""
        if not parts:
            return cls.none()
        plain: dict[str, Any] = {
            each.name: np.concatenate([getattr(part, each.name) for part in parts])
            for each in fields(cls)
            if each.name != "context"
        }
        quantities = dict.fromkeys(quantity for part in parts for quantity in part.context)
        context = {
            q: np.concatenate([part.context[q] if q in part.context else np.full(len(part), np.nan) for part in parts])
            for q in quantities
        }
        return cls(**plain, context=context)

    @classmethod
    def none(cls) -> "Strides":
        """No strides."""
        blank: dict[str, Any] = {each.name: np.empty(0) for each in fields(cls) if each.name != "context"}
        blank |= {"rows": np.empty(0, np.int64), "known": np.empty(0, bool), "force": np.empty((0, len(LAGS)))}
        return cls(**blank)

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads."""
        return table(self)

    @classmethod
    def restore(cls, state: State) -> "Strides":
        """Strides from their state.

        Raises
        ------
        StateError
            It is not that of strides, or not one that the model could use.
        """
        n, context = len(array(state, "t", (-1,))), substate(state, "context")
        columns: dict[str, Any] = {
            each.name: array(state, each.name, (n,), finite=False)
            for each in fields(cls)
            if each.name not in ("rows", "known", "force", "context")
        }
        columns["rows"] = array(state, "rows", (n,), np.int64)
        columns["known"] = array(state, "known", (n,), np.bool_)
        columns["force"] = array(state, "force", (n, len(LAGS)), finite=False)
        columns["context"] = {q: array(context, q, (n,), finite=False) for q in names(context, Quantity)}
        strides = cls(**columns)
        needed = [strides.v0, strides.v1, strides.a, strides.speed_squared, *strides.force.T]
        if not np.isfinite(np.array(needed)[:, strides.known]).all() or not np.isfinite([strides.s0, strides.s1]).all():
            raise StateError("strides: are not all complete")
        if not np.isfinite(strides.speed[np.isfinite(strides.gravity)]).all():
            raise StateError("strides: have an acceleration without a speed")
        if np.any(strides.rows < 0) or np.any(strides.s1 < strides.s0):
            raise StateError("strides: rows or distances run backwards")
        return strides

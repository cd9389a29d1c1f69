"""The two arrays-of-everything that flow through the estimator: rows of the time grid, and admitted samples."""

from collections.abc import Mapping
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from estimator.signals import Floats, Mask, Role

STEP = 0.1  # s, the time grid: wheel speed comes at 10 Hz on nearly every bus
HARDEST = 12.0  # m/s^2: no tyre holds more, so a speed that changes faster is not the vehicle's


@dataclass(frozen=True, slots=True)
class Rows:
    """Signals on the time grid, oldest first; all arrays (n,), NaN where a signal is stale or not available.

    ``index`` counts steps of STEP since time zero; ``speed`` [m/s]; ``power`` [W] at the wheels; ``context`` holds
    the other bound roles in SI; ``fresh`` says for speed and power (n, 2) whether a reading was there at all.
    """

    index: NDArray[np.int64]
    speed: Floats
    power: Floats
    fresh: Mask
    context: Mapping[Role, Floats]

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, part: slice) -> "Rows":
        context = {role: values[part] for role, values in self.context.items()}
        return Rows(self.index[part], self.speed[part], self.power[part], self.fresh[part], context)

    @property
    def t(self) -> Floats:
        """Grid times [s]."""
        return self.index * STEP

    @property
    def plausible_speed(self) -> Floats:
        """Speed [m/s], NaN on either side of a jump: a locked wheel, a sensor that starts anew, a wrong bit.

        One such value would outweigh an hour of driving in the fit, and be the last to leave the window.
        """
        jump = np.abs(np.diff(self.speed)) > HARDEST * STEP
        return np.where(np.append(jump, False) | np.insert(jump, 0, False), np.nan, self.speed)

    @classmethod
    def concatenate(cls, a: "Rows", b: "Rows") -> "Rows":
        """``a`` followed by ``b``; a role that only one of them has is NaN in the other."""
        roles = [*a.context, *(role for role in b.context if role not in a.context)]
        blank = {id(part): np.full(len(part), np.nan) for part in (a, b)}
        return cls(
            np.concatenate([a.index, b.index]),
            np.concatenate([a.speed, b.speed]),
            np.concatenate([a.power, b.power]),
            np.concatenate([a.fresh, b.fresh]),
            {r: np.concatenate([a.context.get(r, blank[id(a)]), b.context.get(r, blank[id(b)])]) for r in roles},
        )


@dataclass(frozen=True, slots=True)
class Samples:
    """What the model is fitted to; all arrays (n,).

    Smoothed speed ``v`` [m/s], acceleration ``a`` [m/s^2] and power ``P`` [W] with its rate ``dP`` [W/s]; and their
    instruments ``zv``, ``za``, ``zdP``: the same quantities from readings around, but not at, the moment.
    ``density`` of the air [kg/m^3], NaN where temperature or pressure is not known.
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

    def __len__(self) -> int:
        return len(self.t)

    @property
    def complete(self) -> Mask:
        """Where everything that the model needs is known; it can do without the density."""
        needed = [getattr(self, field.name) for field in fields(self) if field.name != "density"]
        known: Mask = np.all(np.isfinite(needed), axis=0)
        return known

    @property
    def relative_density(self) -> Floats:
        """Density of the air over its mean here, 1 where it is not known."""
        known = np.isfinite(self.density)
        mean = self.density[known].mean() if known.any() else 1.0
        return np.where(known, self.density / mean, 1.0)

    def __getitem__(self, part: slice | Mask | NDArray[np.intp]) -> "Samples":
        return Samples(*(getattr(self, field.name)[part] for field in fields(self)))

    @classmethod
    def concatenate(cls, parts: "list[Samples]") -> "Samples":
        """Join in order; no parts give no samples."""
        if not parts:
            return cls(*(np.empty(0) for _ in fields(cls)))
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))

"""Scales of road and noise that a search has found, with the orders of the model that they belong to."""

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from estimator.checkpoint.validation import Count, State, array, optional, read
from estimator.errors import StateError
from estimator.model.road import ALPHAS, LEVEL, ROUGH, SMOOTH, RoadModel
from estimator.model.road_nodes import Place, References, warping
from estimator.model.road_scales import LENGTH, POWER, SCALES, SLOPE, TORQUE, OperatingPoint
from estimator.signals import Floats
from estimator.strides import LAGS, Strides

# Log evidence that noise of the power needs to be in the model: it explains nearly what noise of the torque does, and
# the coefficients are corrected for the latter alone. It has 24 to 318 where it is real (a truck at 1 Hz, a BMW i3).
POWER_PRICE = 3.0
# The same for a road that is smoother than crests and dips make it: drives of minutes hardly tell, and beside a smooth
# road their masses were too sure (errors of 1.4 to 1.9 standard deviations in the first six minutes, else 1.0 to 1.3).
SMOOTH_PRICE = 3.0
# The same for a road that is designed for the speed it is driven at: on level simulated roads it has up to 8 where
# loads act at low speed. On 21 of 28 trips of the BMW it has more, 16 in the median; with the accelerometer on 25, 38.
DESIGNED_PRICE = 8.0
# The same for each place where the vehicle turns: of 143 other slow places on five simulated drives none has more than
# 3.4, and the turns of these routes there and back have 43 to 213.
TURN_PRICE = 8.0


@dataclass(frozen=True, kw_only=True)
class RoadScales:
    """Scales of road and noise (k,) in the order of `RoadModel.scales`, the orders of road and wander, and design.

    Noise of the force has its scales at a ``point``. Other strides that they are used on may have another one. It is
    None, for that of any strides, where no engine speed is known: gearings then have no unit.
    """

    values: Floats
    point: OperatingPoint | None
    alpha: int  # of ALPHAS, or LEVEL
    wander: int  # order of the wander of the signals of the road
    readings: tuple[str, ...]  # those signals, whose scales are among the values
    lag: int  # place in LAGS
    designed: bool = False  # the road is designed for the speed it is driven at
    turns: tuple[Place, ...] = ()  # where slopes change at once
    power_chance: float = 0.0  # probability that noise of the power is there, where it is not in the model
    lost: tuple["RoadScales", ...] = ()  # less probable ones of other orders: the next search goes on from there

    @property
    def orders(self) -> tuple[int, int, bool, bool]:
        """Orders of road and wander, noise of the power and design."""
        return self.alpha, self.wander, self.has_power, self.designed

    @property
    def has_power(self) -> bool:
        """Whether noise of the power is in the model."""
        return bool(self.values[POWER] > SCALES[POWER].low)

    @property
    def price(self) -> float:
        """Log evidence that these orders must add to be chosen [nats]."""
        smooth = SMOOTH_PRICE * (self.alpha == ALPHAS[-1])
        changes = 0.0 if self.alpha == LEVEL else DESIGNED_PRICE * self.designed + TURN_PRICE * len(self.turns)
        return POWER_PRICE * self.has_power + smooth + changes

    def warping(self, speed: Floats) -> Floats:
        """Factor (n,) by which slopes change over less distance at a ``speed`` (n,) [m/s] than the slope length."""
        return warping(speed) if self.designed else np.ones(len(speed))

    @property
    def free(self) -> list[int]:
        """Places of the scales that the model has."""
        held = [*([SLOPE, LENGTH] if self.alpha == LEVEL else []), *([] if self.has_power else [POWER, POWER + 1])]
        return [i for i in range(len(self.values)) if i not in held]

    def model_of(self, strides: Strides, references: References | None = None) -> RoadModel:
        """The model of strides that these are scales of; ``references`` are by default those of the strides."""
        return RoadModel(
            strides, self.alpha, self.wander, self.has_power, self.designed, self.turns, self.point, references
        )

    def at(self, point: OperatingPoint | None) -> "RoadScales":
        """These scales, and those ``lost``, of the same noise at another ``point``; the usual engine speed stays.

        Where either point is None, the values stay.
        """
        values, lost = self.values.copy(), tuple(lost.at(point) for lost in self.lost)
        if point is not None and self.point is not None:
            values[TORQUE] *= point.gearing / self.point.gearing
            if self.has_power:
                least = np.nextafter(SCALES[POWER].low, np.inf)
                values[POWER] = max(values[POWER] * self.point.speed / point.speed, least)
            point = replace(point, turns=self.point.turns)
        return replace(self, values=values, point=point, lost=lost)

    def state(self) -> dict[str, Any]:
        """The state that `restored` reads, without those that were lost."""
        return {
            "values": self.values,
            "point": None if self.point is None else asdict(self.point),
            "alpha": self.alpha,
            "wander": self.wander,
            "readings": list(self.readings),
            "lag": self.lag,
            "designed": self.designed,
            "turns": np.array(self.turns, float).reshape(-1, 2),
            "power_chance": self.power_chance,
        }

    @classmethod
    def restored(cls, state: State) -> "RoadScales":
        """The scales whose `state` this is.

        Raises
        ------
        StateError
            It is not one of scales of a road model.
        """
        values = array(state, "values", (-1,))
        readings = tuple(read(state, "readings", list[str]))
        alpha, wander, lag = read(state, "alpha", int), read(state, "wander", int), read(state, "lag", Count)
        chance, designed = read(state, "power_chance", float), read(state, "designed", bool)
        whole = len(values) == len(SCALES) + 3 * len(readings) and np.all(values > 0)
        if (
            alpha not in ALPHAS
            or wander not in (ROUGH, SMOOTH)
            or lag >= len(LAGS)
            or not whole
            or not 0 <= chance <= 1
        ):
            raise StateError("scales: are not those of a road model")
        return cls(
            values=values,
            point=optional(state, "point", _restored_point),
            alpha=alpha,
            wander=wander,
            readings=readings,
            lag=lag,
            designed=designed,
            turns=tuple((begin, end) for begin, end in array(state, "turns", (-1, 2)).tolist()),
            power_chance=chance,
        )


def _restored_point(state: State) -> OperatingPoint:
    turns, gearing, speed = (read(state, name, float) for name in ("turns", "gearing", "speed"))
    if min(turns, gearing, speed) <= 0:
        raise StateError("point: is not positive")
    return OperatingPoint(turns, gearing, speed)

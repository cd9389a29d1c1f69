"""Power at the wheels, at the times of the torque readings (J1939-71: percent torques refer to SPN 544).

The first bound source is used: power; torque and engine speed; voltage and current of the traction battery; indicated
torque less friction torque, as fractions of the reference torque.
"""

from collections.abc import Mapping, Set
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.checkpoint.validation import State, read, substate
from estimator.roles import BATTERY, is_electric
from estimator.settings import Positive, Vehicle
from estimator.signals import Floats, Mask, Role, Series
from estimator.streaming.friction import FrictionCurve
from estimator.streaming.resampling import Track, block_bounds

NO_LIMIT = np.inf
NO_SERIES = Series(np.empty(0), np.empty(0))
SPIKE_WINDOW = 5  # readings, for the running median
# Robust sd of the differences from the running median, from which a reading is an error. Chosen by hand: with 4 and 16
# the mass of three simulated drives moves by at most 0.14 sd.
MIN_SPIKE_SDS = 8.0
MIN_SPREAD_SHARE = 0.02  # sd over the usual power: with a smaller one, a step of resolution would count as a spike
MAD_TO_SD = 1.4826  # of a Gaussian


def needed(vehicle: Vehicle, bound: Set[Role]) -> list[Role]:
    """Roles that power is computed from, given those that are ``bound``; without one of them it is unknown."""
    if Role.ENGINE_POWER in bound:
        return [Role.ENGINE_POWER]
    if Role.ENGINE_TORQUE in bound:
        return [Role.ENGINE_TORQUE, Role.ENGINE_SPEED]
    if is_electric(bound):
        return sorted(BATTERY)
    roles = [Role.TORQUE_FRACTION, Role.ENGINE_SPEED]
    if Role.FRICTION_FRACTION in bound:
        roles.append(Role.FRICTION_FRACTION)
    if vehicle.subtract_parasitic_losses:
        roles.append(Role.PARASITIC_FRACTION)
    if vehicle.reference_torque_Nm is None:
        roles.append(Role.REFERENCE_TORQUE)
    return roles


class EnginePower:
    """Extends a `track` of power [W] by new readings, and keeps the constants of the engine.

    Parameters
    ----------
    vehicle, bound, despike
        See `Aligner`.
    tracks
        Recent readings by role and its number in the configuration; call `extend` after adding to them.
    """

    def __init__(
        self, vehicle: Vehicle, bound: frozenset[Role], despike: bool, tracks: Mapping[tuple[Role, int], Track]
    ) -> None:
        self._vehicle, self._bound, self._despike, self._tracks = vehicle, bound, despike, tracks
        self._restart()
        self.forget()

    def _restart(self) -> None:
        self.track, self._lead_track = Track(), Track()
        self._powered_to = -np.inf  # [s]

    def forget(self) -> None:
        """Discard the constants of the engine: the vehicle may be another one."""
        self._friction = FrictionCurve()
        self._reference: float | None = None  # [N m] from before the start, until the bus sends it

    @property
    def constant_friction(self) -> tuple[float, float, float] | None:
        """See `FrictionCurve.constant`."""
        return self._friction.constant

    def finish(self) -> None:
        """Start a new track at the end of the traffic; the constants of the engine are kept."""
        self._reference = self.reference_torque
        self._restart()

    def state(self) -> dict[str, Any]:
        """State for `restore`: constants of the engine, without the readings of the last seconds."""
        return {"friction": self._friction.state(), "reference": self.reference_torque}

    def restore(self, state: State) -> None:
        """Take the constants of the engine from the `state` of another instance.

        Raises
        ------
        StateError
            The state is not one of `state`.
        """
        self._friction.restore(substate(state, "friction"))
        self._reference = read(state, "reference", Positive | None)

    def extend(self, ends: Floats) -> None:
        """Add the power at the times of new torque readings, in blocks that end at ``ends`` (k,) [s]."""
        if Role.ENGINE_POWER in self._bound:
            given = self._track_of(Role.ENGINE_POWER)
            new = given.t > self._powered_to
            self._append(given.t[new], given.value[new], block_bounds(given.t[new], ends), is_slow=given.is_slow)
            return
        lead, other = (self._track_of(role) for role in self._factors)
        new = lead.t > self._powered_to
        if not len(other.t) or not new.any():
            return
        t, value = lead.t[new], lead.value[new]
        bounds = block_bounds(t, ends)
        if Role.TORQUE_FRACTION in self._factors:
            value = self._net_fraction(t, value, bounds) * self._reference_torque(t)
        elif Role.BATTERY_CURRENT in self._factors and self._vehicle.discharge_current == "negative":
            value = -value
        if not lead.is_slow and np.isfinite(lead.fresh) and not other.is_slow:
            self._lead_track = Track()
        else:
            self._lead_track.add(Series(t, value * self._vehicle.driveline_efficiency))
        self._append(t, value * other.held(t), bounds, is_slow=lead.is_slow)

    def means(self, edges: Floats, known_to: Floats) -> tuple[Floats, Mask]:
        """Mean power [W] (n,), see `Track.means`; where a factor is slow, product of the means of both factors."""
        if Role.ENGINE_POWER in self._bound or not (other := self._track_of(self._factors[1])).is_slow:
            return self.track.means(edges, known_to)
        lead, lead_there = self._lead_track.means(edges, known_to)
        factor, factor_there = other.means(edges, known_to)
        return lead * factor, lead_there & factor_there

    def forget_readings(self, horizon: float) -> None:
        """Drop readings older than ``horizon`` [s]."""
        self.track.forget(horizon)
        self._lead_track.forget(horizon)

    def is_settled(self, readings: Mapping[Role, list[Series]], ends: Floats, forgotten: Floats) -> bool:
        """True if these blocks of readings change no earlier power; see `Track.is_settled`."""
        needed = (Role.ENGINE_POWER,) if Role.ENGINE_POWER in self._bound else self._factors
        if not all(len(self._track_of(role).t) for role in needed):
            return False
        if np.isfinite(self.track.fresh):
            return True
        # There is at most one power at each reading of the first role.
        lead = readings.get(needed[0], [NO_SERIES])[0]
        return self._track_of(needed[0]).is_few(lead, ends, forgotten)

    @property
    def _factors(self) -> tuple[Role, Role]:
        """Two roles whose product is the power; it is computed at the times of the first."""
        if is_electric(self._bound):
            return Role.BATTERY_CURRENT, Role.BATTERY_VOLTAGE
        torque = Role.ENGINE_TORQUE if Role.ENGINE_TORQUE in self._bound else Role.TORQUE_FRACTION
        return torque, Role.ENGINE_SPEED

    def _append(self, t: Floats, value: Floats, bounds: NDArray[np.intp], *, is_slow: bool) -> None:
        if len(t):
            self._powered_to = float(t[-1])
            value = despike(value, bounds) if self._despike and not is_slow else value
            self.track.add(Series(t, value * self._vehicle.driveline_efficiency))

    def _track_of(self, role: Role) -> Track:
        return self._tracks.get((role, 0), Track())

    def _net_fraction(self, t: Floats, indicated: Floats, bounds: NDArray[np.intp]) -> Floats:
        """Indicated torque less friction torque (n,), as a fraction of the reference torque."""
        fine = self._track_of(Role.TORQUE_FRACTION_FINE).held(t)
        fraction = indicated + np.where(np.isfinite(fine), fine, 0.0)
        if Role.FRICTION_FRACTION in self._bound:
            friction, speed = self._track_of(Role.FRICTION_FRACTION), self._track_of(Role.ENGINE_SPEED)
            speed_then = speed.held(friction.time_of_held(t))
            fraction = fraction - self._friction.refine(speed.held(t), friction.held(t), speed_then, bounds)
        if self._vehicle.subtract_parasitic_losses:
            fraction = fraction - self._track_of(Role.PARASITIC_FRACTION).held(t)
        return fraction

    def _reference_torque(self, t: Floats) -> Floats:
        if self._vehicle.reference_torque_Nm is not None:
            return np.full(len(t), self._vehicle.reference_torque_Nm)
        # A constant of the engine, sent every few seconds: the last value is held.
        heard = self._track_of(Role.REFERENCE_TORQUE)
        held = heard.held(t, NO_LIMIT)
        if self._reference is None:
            return held
        return np.where(np.isnan(heard.time_of_held(t)), self._reference, held)

    @property
    def reference_torque(self) -> float | None:
        """Newest reference torque [N m] that the bus sent."""
        heard = self._track_of(Role.REFERENCE_TORQUE).value
        finite = heard[np.isfinite(heard)]
        return float(finite[-1]) if len(finite) else self._reference


def despike(value: Floats, bounds: NDArray[np.intp]) -> Floats:
    """Readings (n,) with gross errors replaced by the median of their neighbours (Hampel 1974).

    A reading is a gross error if it differs from that median by more than MIN_SPIKE_SDS robust standard deviations.
    These are of such differences in its block between ``bounds`` (k + 1,). The running median follows ramps and steps,
    so only isolated readings are replaced.
    """
    finite = np.flatnonzero(np.isfinite(value))
    x, within = value[finite], np.searchsorted(finite, bounds)
    local = _running_median(x, within)
    off = np.abs(x - local)
    limit = np.full(len(x), NO_LIMIT)
    for low, high in pairwise(within.tolist()):
        if high - low >= SPIKE_WINDOW:
            spread = float(np.median(off[low:high])), MIN_SPREAD_SHARE * float(np.median(np.abs(x[low:high])))
            limit[low:high] = MIN_SPIKE_SDS * MAD_TO_SD * max(spread)
    cleaned = value.copy()
    cleaned[finite[off > limit]] = local[off > limit]
    return cleaned


def _running_median(x: Floats, bounds: NDArray[np.intp]) -> Floats:
    """Running median (n,) of SPIKE_WINDOW readings; each block is padded with its first and last reading."""
    count = np.diff(bounds)
    first, last = np.repeat(bounds[:-1], count), np.repeat(bounds[1:] - 1, count)
    index = np.arange(len(x))
    a, b, c, d, e = (x[np.clip(index + k, first, last)] for k in range(-(SPIKE_WINDOW // 2), SPIKE_WINDOW // 2 + 1))
    # Neither the smaller of two smaller ones nor the larger of two larger ones is the median of all five.
    low = np.maximum(np.minimum(a, b), np.minimum(d, e))
    high = np.minimum(np.maximum(a, b), np.maximum(d, e))
    median: Floats = np.maximum(np.minimum(low, high), np.minimum(c, np.maximum(low, high)))
    return median

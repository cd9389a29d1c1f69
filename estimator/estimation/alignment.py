"""Readings at their senders' own times become rows of one time grid.

A row stands for the interval of STEP around its time. Speed and power are means of the straight lines between
readings over that interval: both sides of the model get the same low-pass, whatever their senders' rates and phases.
Other roles are held from their last reading. Nothing is held or bridged for longer than FRESH_PERIODS times the
usual interval between readings: what is missing is NaN.
"""

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from estimator.config import Positive, Vehicle
from estimator.estimation.friction import FrictionCurve
from estimator.samples import STEP, Rows
from estimator.signals import Floats, Mask, Role, Series
from estimator.state import State, read, substate

FRESH_PERIODS = 3.0  # sender periods after which a reading is stale
SHORTEST_FRESH = 0.3  # s, for senders whose rate follows the engine speed
LONGEST_FRESH = 15.0  # s, for slow senders
SETTLE = 3.0  # s, rows lag this far behind the newest reading, so that straight lines have both ends
FOR_EVER = np.inf
SPIKE_WINDOW = 5  # readings, for the running median
SPIKE_SDS = 8.0
SMALLEST_SPREAD = 0.02  # of the usual power: below, one quantum of the sender would pass for a spike
MAD_TO_SD = 1.4826  # of a Gaussian
TORQUE_ROLES = (Role.TORQUE_FRACTION_FINE, Role.FRICTION_FRACTION, Role.PARASITIC_FRACTION, Role.REFERENCE_TORQUE)

Readings = Mapping[Role, list[Series]]


class _Track:
    """Recent readings of one signal, and how long one of them counts."""

    def __init__(self) -> None:
        self.t = np.empty(0)
        self.value = np.empty(0)
        self.fresh = np.nan

    def add(self, series: Series) -> None:
        later = series.t > (self.t[-1] if len(self.t) else -np.inf)
        t, value = series.t[later], series.value[later]
        ascending = np.concatenate([[True], t[1:] > np.maximum.accumulate(t)[:-1]]) if len(t) else later[:0]
        self.t = np.concatenate([self.t, t[ascending]])
        self.value = np.concatenate([self.value, value[ascending]])
        if np.isnan(self.fresh) and len(self.t) > 4:
            period = float(np.median(np.diff(self.t)))
            self.fresh = min(max(FRESH_PERIODS * period, SHORTEST_FRESH), LONGEST_FRESH)

    @property
    def limit(self) -> float:
        return LONGEST_FRESH if np.isnan(self.fresh) else self.fresh

    def forget(self, before: float) -> None:
        # One reading before the horizon stays: it is the one that is held.
        first = max(int(np.searchsorted(self.t, before)) - 1, 0)
        self.t, self.value = self.t[first:], self.value[first:]

    def time_of_held(self, at: Floats) -> Floats:
        """When the last reading at or before each time came, NaN where there is none."""
        last = np.searchsorted(self.t, at, side="right") - 1
        return np.where(last >= 0, self.t[np.maximum(last, 0)], np.nan) if len(self.t) else np.full(len(at), np.nan)

    def held(self, at: Floats, limit: float | None = None) -> Floats:
        """The last reading at or before each time, NaN once it is stale."""
        if not len(self.t):
            return np.full(len(at), np.nan)
        last = np.searchsorted(self.t, at, side="right") - 1
        age = at - self.t[last]
        limit = self.limit if limit is None else limit
        return np.where((last >= 0) & (age <= limit), self.value[np.maximum(last, 0)], np.nan)


def cell_means(t: Floats, value: Floats, edges: Floats, limit: float) -> tuple[Floats, Mask]:
    """Mean over each cell between ``edges`` (n + 1,) of the straight lines through readings.

    NaN in a cell that a line longer than ``limit`` [s], or one from a NaN reading, passes through; the second array
    says in which cells no such long line passes, that is, where readings were there.
    """
    n = len(edges) - 1
    if len(t) < 2:
        return np.full(n, np.nan), np.zeros(n, dtype=bool)
    width = np.diff(t)
    bad = ~np.isfinite(value)
    known = np.where(bad, 0.0, value)
    area = np.concatenate([[0.0], np.cumsum((known[1:] + known[:-1]) / 2 * width)])
    segment = np.clip(np.searchsorted(t, edges, side="right") - 1, 0, len(t) - 2)
    inside = edges - t[segment]
    slope = (known[segment + 1] - known[segment]) / width[segment]
    integral = area[segment] + inside * (known[segment] + slope * inside / 2)
    mean = np.diff(integral) / np.diff(edges)

    def touched(flag: Mask) -> Mask:
        count = np.concatenate([[0], np.cumsum(flag)])
        return count[segment[1:] + 1] > count[segment[:-1]]

    there = ~touched(width > limit) & (edges[:-1] >= t[0]) & (edges[1:] <= t[-1])
    return np.where(there & ~touched(bad[1:] | bad[:-1]), mean, np.nan), there


def despike(value: Floats) -> Floats:
    """Readings (n,) with gross errors replaced by the median of their neighbours (Hampel 1974).

    A reading is grossly wrong when it is off that median by SPIKE_SDS robust standard deviations of such
    differences in the batch. The running median follows ramps and steps, so only lone readings can be.
    """
    known = np.flatnonzero(np.isfinite(value))
    if len(known) < SPIKE_WINDOW:
        return value
    x = value[known]
    around = sliding_window_view(np.pad(x, SPIKE_WINDOW // 2, mode="edge"), SPIKE_WINDOW)
    local: Floats = np.median(around, axis=1)
    off = np.abs(x - local)
    limit = SPIKE_SDS * MAD_TO_SD * max(float(np.median(off)), SMALLEST_SPREAD * float(np.median(np.abs(x))))
    cleaned = value.copy()
    cleaned[known[off > limit]] = local[off > limit]
    return cleaned


class Aligner:
    """Turns batches of readings into rows, about SETTLE behind the newest reading.

    ``bound`` are the roles that the configuration expects: a term of the power that is expected but has not come
    makes the power unknown, not larger. ``despike`` repairs lone gross errors of power.
    """

    def __init__(self, vehicle: Vehicle, bound: frozenset[Role], despike: bool = True) -> None:
        self._vehicle = vehicle
        self._despike = despike
        self._bound = bound
        self._restart()
        self.forget()

    def _restart(self) -> None:
        self._tracks: dict[tuple[Role, int], _Track] = {}
        self._power = _Track()
        self._powered_to = -np.inf
        self._next: int | None = None

    def forget(self) -> None:
        """Forget what the engine has shown of itself: it may be another one."""
        self._friction = FrictionCurve()
        self._reference: float | None = None  # [N m] from before the start, until the bus sends it

    def feed(self, readings: Readings, now: float) -> Iterator[Rows]:
        """Add a batch that ends at time ``now`` [s]; yields the rows that have become complete."""
        for role, parts in readings.items():
            for i, series in enumerate(parts):
                self._tracks.setdefault((role, i), _Track()).add(series)
        self._extend_power()
        horizon = int(np.floor((now - SETTLE) / STEP))
        if self._next is None:
            starts = [track.t[0] for track in self._tracks.values() if len(track.t)]
            if not starts:
                return
            self._next = int(np.ceil(min(starts) / STEP))
        if horizon > self._next:
            yield self._rows(np.arange(self._next, horizon, dtype=np.int64))
            self._next = horizon
            for track in [*self._tracks.values(), self._power]:
                track.forget(horizon * STEP - SETTLE)

    def finish(self, now: float) -> Iterator[Rows]:
        """The rows still waiting at time ``now`` [s] when nothing more comes; only the engine is remembered then."""
        yield from self.feed({}, now + SETTLE)
        self._reference = self._newest_reference()
        self._restart()

    def state(self) -> dict[str, Any]:
        """What the engine has shown of itself; not the readings of the last seconds."""
        return {"friction": self._friction.state(), "reference": self._newest_reference()}

    def restore(self, state: State) -> None:
        """Know of the engine what another aligner knew; for one that has not been fed.

        Raises
        ------
        StateError
            The state is not that of an aligner.
        """
        self._friction.restore(substate(state, "friction"))
        self._reference = read(state, "reference", Positive | None)

    def _newest_reference(self) -> float | None:
        heard = self._track(Role.REFERENCE_TORQUE).value
        known = heard[np.isfinite(heard)]
        return float(known[-1]) if len(known) else self._reference

    def _track(self, role: Role) -> _Track:
        return self._tracks.get((role, 0), _Track())

    def _extend_power(self) -> None:
        """Power [W] at the times of the torque readings (J1939-71: percent torques refer to SPN 544)."""
        if Role.ENGINE_POWER in self._bound:
            track = self._track(Role.ENGINE_POWER)
            new = track.t > self._powered_to
            self._append_power(track.t[new], track.value[new])
            return
        lead = Role.ENGINE_TORQUE if Role.ENGINE_TORQUE in self._bound else Role.TORQUE_FRACTION
        torque, speed = self._track(lead), self._track(Role.ENGINE_SPEED)
        new = torque.t > self._powered_to
        if not len(speed.t) or not new.any():
            return
        t, value = torque.t[new], torque.value[new]
        if lead == Role.TORQUE_FRACTION:
            value = self._net_fraction(t, value) * self._reference_torque(t)
        self._append_power(t, value * speed.held(t))

    def _append_power(self, t: Floats, value: Floats) -> None:
        if len(t):
            self._powered_to = float(t[-1])
            value = despike(value) if self._despike else value
            self._power.add(Series(t, value * self._vehicle.driveline_efficiency))

    def _net_fraction(self, t: Floats, indicated: Floats) -> Floats:
        """Indicated less friction torque, as fractions of the reference torque."""
        fine = self._track(Role.TORQUE_FRACTION_FINE).held(t)
        fraction = indicated + np.where(np.isfinite(fine), fine, 0.0)
        if Role.FRICTION_FRACTION in self._bound:
            friction, speed = self._track(Role.FRICTION_FRACTION), self._track(Role.ENGINE_SPEED)
            speed_then = speed.held(friction.time_of_held(t))
            fraction = fraction - self._friction.refine(speed.held(t), friction.held(t), speed_then)
        if self._vehicle.subtract_parasitic_losses:
            fraction = fraction - self._track(Role.PARASITIC_FRACTION).held(t)
        return fraction

    def _reference_torque(self, t: Floats) -> Floats:
        if self._vehicle.reference_torque_Nm is not None:
            return np.full(len(t), self._vehicle.reference_torque_Nm)
        # A constant of the engine, sent every few seconds: once heard it holds.
        track = self._track(Role.REFERENCE_TORQUE)
        held = track.held(t, FOR_EVER)
        if self._reference is None:
            return held
        return np.where(np.isnan(track.time_of_held(t)), self._reference, held)

    def _rows(self, index: NDArray[np.int64]) -> Rows:
        edges = (np.append(index, index[-1] + 1) - 0.5) * STEP
        speed, speed_there = self._speed(edges)
        power, power_there = cell_means(self._power.t, self._power.value, edges, self._power.limit)
        at = index * STEP
        context: dict[Role, Floats] = {}
        for (role, i), track in self._tracks.items():
            if i == 0 and role not in (Role.SPEED, Role.WHEEL_SPEEDS, Role.ENGINE_POWER, *TORQUE_ROLES):
                if role in (Role.LONGITUDINAL_ACCELERATION, Role.ALTITUDE, Role.GRADE):
                    context[role] = cell_means(track.t, track.value, edges, track.limit)[0]
                else:
                    context[role] = track.held(at)
        return Rows(index, speed, power, np.column_stack([speed_there, power_there]), context)

    def _speed(self, edges: Floats) -> tuple[Floats, Mask]:
        """The speed signal, or the mean of the wheel speeds where there is none."""
        wheels = [k for k in self._tracks if k[0] == Role.WHEEL_SPEEDS]
        keys = [(Role.SPEED, 0)] if Role.SPEED in self._bound else wheels
        if not any(key in self._tracks for key in keys):
            return np.full(len(edges) - 1, np.nan), np.zeros(len(edges) - 1, dtype=bool)
        tracks = [self._tracks[key] for key in keys]
        means, there = zip(*(cell_means(track.t, track.value, edges, track.limit) for track in tracks), strict=True)
        # A wheel without a valid speed is left out; where none has one there is none.
        known = np.isfinite(means)
        total = np.where(known, means, 0.0).sum(axis=0)
        count = known.sum(axis=0)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan), np.any(there, axis=0)

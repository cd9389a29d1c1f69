"""Resampling of readings, from the times of their senders to rows of one time grid.

A row is the interval of STEP around its time. Readings of speed and power are interpolated linearly and averaged over
that interval. Both sides of the model so have the same low-pass, at all rates and phases of the senders. Other roles
hold their last reading.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.checkpoint.validation import State, substate
from estimator.preparation.past_speed import PastSpeed
from estimator.roles import BATTERY, is_electric
from estimator.samples import STEP, Rows
from estimator.settings import Vehicle
from estimator.signals import Floats, Mask, Quantity, Role, Series
from estimator.streaming.engine_power import EnginePower
from estimator.streaming.frozen_rows import FrozenRows
from estimator.streaming.lone_errors import lone_errors
from estimator.streaming.resampling import MAX_FRESH, Track
from estimator.streaming.wheels import Wheels

# s, between readings of speed or of power that show how they change. Longer straight lines hide it: a truck read every
# second is 3 % too light, read every two seconds 6 %.
MAX_LINE = 4.0
MAX_SILENCE = 30.0  # s without such readings, after which there are no rows: as without any frame
SETTLE = 3.0  # s, rows lag this far behind the newest reading, so that straight lines have both ends
NO_CONTEXT = {  # speed and power are computed from them
    Role.SPEED,
    Role.WHEEL_SPEEDS,
    Role.ENGINE_POWER,
    Role.TORQUE_FRACTION_FINE,
    Role.FRICTION_FRACTION,
    Role.PARASITIC_FRACTION,
    Role.REFERENCE_TORQUE,
}
# s beyond the rows that wait: engine speeds are looked up at the times of friction readings, as long as these count.
MEMORY = {Role.ENGINE_SPEED: MAX_FRESH}
# Gravity is low-passed as speed and power are; a position that is held would be late by up to 25 m.
AVERAGED = {Role.LONGITUDINAL_ACCELERATION, Role.ALTITUDE, Role.GRADE, Role.LATITUDE, Role.LONGITUDE}

SPEEDS = {Role.SPEED, Role.WHEEL_SPEEDS}
COARSE_STEP = 0.1  # m/s of a speed that is a staircase at usual accelerations: whole km/h, not 0.1 km/h
LONE_ERROR = "contradicted by the readings before and after"
SAME_TIME = "at the time of another reading, or before it"

Readings = Mapping[Role, list[Series]]


class Aligner:
    """Turns batches of readings into rows, about SETTLE behind the newest reading.

    Parameters
    ----------
    vehicle
        Settings of engine and driveline.
    bound
        Roles that the configuration expects: while one of the torques is missing, the power is unknown, not larger.
    despike
        True if isolated gross errors of power are repaired, and those of speed dropped.
    speed_step
        Resolution of the speed on the bus [m/s].

    Attributes
    ----------
    silent : int
        Rows left out, in blocks that begin MAX_SILENCE after speed or power were last read often enough.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        bound: frozenset[Role],
        despike: bool = True,
        speed_step: float = 0.0,
    ) -> None:
        self._dropped: Counter[str] = Counter()
        self._speed_step = speed_step
        self._bound, self._despike = bound, despike
        self._tracks: dict[tuple[Role, int], Track] = {}
        self._hidden = NO_CONTEXT if is_electric(bound) else NO_CONTEXT | BATTERY
        # Torque comes in as coarse steps as such a speed does: one of them would count as a gross error.
        self._engine = EnginePower(vehicle, bound, despike and speed_step < COARSE_STEP, self._tracks)
        self._past, self._frozen, self._wheels = PastSpeed(), FrozenRows(), Wheels()
        self._next: int | None = None
        self._heard_to = -np.inf  # [s], up to where speed or power were read often enough
        self.silent = 0

    @property
    def refused(self) -> Counter[str]:
        """Readings that were dropped, and rows in which a wheel was left out, by role and reason."""
        return self._dropped + self._wheels.refused

    @property
    def reference_torque(self) -> float | None:
        """Newest reference torque of the engine [N m] that the bus sent."""
        return self._engine.reference_torque

    @property
    def constant_friction(self) -> tuple[float, float, float] | None:
        """See `FrictionCurve.constant`."""
        return self._engine.constant_friction

    def forget(self) -> None:
        """Discard the constants of the engine and the past speeds: the vehicle may be another one."""
        self._engine.forget()
        self._past.forget()
        self._wheels.forget()

    def feed(self, readings: Readings, now: float) -> Iterator[Rows]:
        """Add a batch that ends at time ``now`` [s]; yields the rows that have become complete."""
        yield from filter(None, self.feed_blocks(readings, np.array([now])))

    def feed_blocks(self, readings: Readings, ends: Floats) -> Iterator[Rows | None]:
        """Add blocks that end at ``ends`` (k,) [s]; yields for each the rows complete since the last ones, or None.

        Blocks that would change how later ones are read, such as the first of a sender, are added one by one.
        """
        if len(ends) > 1 and not self._is_settled(readings, ends):
            half = len(ends) // 2
            yield from self.feed_blocks(between(readings, -np.inf, ends[half - 1]), ends[:half])
            yield from self.feed_blocks(between(readings, ends[half - 1], np.inf), ends[half:])
            return
        for role, parts in readings.items():
            for i, series in enumerate(parts):
                dropped = self._tracks.setdefault((role, i), Track(MEMORY.get(role, 0.0))).add(series)
                if dropped:
                    self._dropped[f"{role.value}: {SAME_TIME}"] += dropped
        if self._despike:
            self._drop_lone_errors()
        self._engine.extend(ends)
        yield from self._advance(ends)

    def _advance(self, ends: Floats) -> Iterator[Rows | None]:
        """Rows of blocks that end at ``ends`` (k,) [s], each up to SETTLE before its end; see `_is_settled`.

        Rows of a run of blocks come with its last.
        """
        horizons = _horizons(ends)
        if self._next is None:
            starts = [track.t[0] for track in self._tracks.values() if len(track.t)]
            if not starts:
                yield None
                return
            self._next = int(np.ceil(min(starts) / STEP))
            self._heard_to = self._next * STEP
        first, last = self._next, int(horizons[-1])
        if last <= first:
            yield None
            return
        runs = list(self._runs(np.append(first, horizons), horizons, ends))
        self._next = last
        for track in self._tracks.values():
            track.forget(last * STEP - SETTLE)
        self._engine.forget_readings(last * STEP - SETTLE)
        for blocks, rows in runs:
            yield from [None] * (blocks - 1)
            yield self._frozen.finish() if rows is None else self._frozen.feed(rows)

    def _runs(
        self, bounds: NDArray[np.int64], horizons: NDArray[np.int64], ends: Floats
    ) -> Iterator[tuple[int, Rows | None]]:
        """Runs of blocks between the row indices ``bounds`` (k + 1,): their number, and rows; None where silent."""
        silent = self._are_silent(bounds)
        for is_silent, run in groupby(range(len(ends)), silent.__getitem__):
            blocks = [*run]
            low, high = int(bounds[blocks[0]]), int(bounds[blocks[-1] + 1])
            if is_silent:
                self.silent += high - low
                yield len(blocks), None
            else:
                yield len(blocks), self._rows(np.arange(low, high, dtype=np.int64), horizons, ends)

    def _are_silent(self, bounds: NDArray[np.int64]) -> list[bool]:
        """Flags (k,) of blocks between ``bounds`` (k + 1,) that begin MAX_SILENCE after the last line so far."""
        tracks = [self._engine.track, *(self._tracks[key] for key in self._speed_keys if key in self._tracks)]
        ends = [track.t[1:][np.diff(track.t) <= MAX_LINE] for track in tracks]
        heard = np.sort(np.concatenate([[self._heard_to], *ends]))
        at = bounds * STEP
        last = heard[np.maximum(np.searchsorted(heard, at[1:], side="right") - 1, 0)]
        self._heard_to = float(last[-1])
        silent: list[bool] = (at[:-1] - last > MAX_SILENCE).tolist()
        return silent

    def _is_settled(self, readings: Readings, ends: Floats) -> bool:
        """True if several blocks can be added at once: no new sender, and no period of a sender learnt among them."""
        horizons = _horizons(ends)
        if self._next is None or horizons[0] <= self._next:
            return False
        if not self._engine.is_settled(readings, ends, horizons * STEP - SETTLE):
            return False
        for role, parts in readings.items():
            for i, series in enumerate(parts):
                track = self._tracks.get((role, i))
                if track is None or not track.is_settled(series, ends, horizons * STEP - SETTLE):
                    return False
                if self._despike and role in SPEEDS and lone_errors(*track.joined(series)).any():
                    return False
        return True

    def finish(self, now: float) -> Iterator[Rows]:
        """Yield the rows still waiting at time ``now`` [s], at the end of the traffic; keeps the engine's constants."""
        yield from self.feed({}, now + SETTLE)
        yield from filter(None, [self._frozen.finish()])
        self._engine.finish()
        self._wheels.pause()
        self._tracks.clear()
        self._next = None

    def state(self) -> dict[str, Any]:
        """State for `restore`: constants of the engine and past speeds, without the readings of the last seconds."""
        return {"engine": self._engine.state(), "past": self._past.state()}

    def restore(self, state: State) -> None:
        """Take the constants of the engine and the past speeds from another aligner, before the first batch.

        Raises
        ------
        StateError
            The state is not that of an aligner.
        """
        self._engine.restore(substate(state, "engine"))
        self._past.restore(substate(state, "past"))

    def _drop_lone_errors(self) -> None:
        """Drop wrong speeds; the straight line between the readings around each then bridges it."""
        for (role, _), track in self._tracks.items():
            if role in SPEEDS and (wrong := lone_errors(track.t, track.value)).any():
                self._dropped[f"{role.value}: {LONE_ERROR}"] += int(wrong.sum())
                track.drop(wrong)

    def _rows(self, index: NDArray[np.int64], horizons: NDArray[np.int64], ends: Floats) -> Rows:
        """Rows of blocks that end at ``ends`` (k,) [s], from ``index`` up to their ``horizons`` (k,)."""
        edges = (np.append(index, index[-1] + 1) - 0.5) * STEP
        known_to = np.append(ends[:-1], np.inf)[np.searchsorted(horizons, index, side="right")]
        by_wheels, wheels_there, contradicted = self._wheel_speed(edges, known_to)
        is_by_wheels = Role.SPEED not in self._bound
        speed, speed_there = (by_wheels, wheels_there) if is_by_wheels else self._speed(edges, known_to)
        power, power_there = self._engine.means(edges, known_to)
        at = index * STEP
        context = {
            role: track.means(edges, known_to)[0] if role in AVERAGED else track.held(at)
            for (role, i), track in self._tracks.items()
            if i == 0 and role not in self._hidden
        }
        derived = {**self._past.follow(index, speed), **self._speed_step_column(len(index))}
        if is_by_wheels and contradicted.any():
            derived |= {Quantity.CONTRADICTED: contradicted.astype(float)}
        elif not is_by_wheels and wheels_there.any():
            context[Role.WHEEL_SPEEDS] = by_wheels  # to be compared with the speed
        return Rows(
            index=index,
            speed=speed,
            power=power,
            fresh=np.column_stack([speed_there, power_there]),
            context=context,
            derived=derived,
        )

    def _speed_step_column(self, count: int) -> dict[Quantity, Floats]:
        """Resolution [m/s] of a coarse speed, repeated for ``count`` rows; empty where the speed is fine."""
        return {Quantity.SPEED_STEP: np.full(count, self._speed_step)} if self._speed_step >= COARSE_STEP else {}

    def _speed(self, edges: Floats, known_to: Floats) -> tuple[Floats, Mask]:
        """Means of the speed signal [m/s] (n,), and where it has readings (n,)."""
        track = self._tracks.get((Role.SPEED, 0), Track())
        return track.means(edges, known_to)

    def _wheel_speed(self, edges: Floats, known_to: Floats) -> tuple[Floats, Mask, Mask]:
        """Speed from the wheels [m/s] (n,), where a wheel has a reading (n,), and where no majority agrees (n,)."""
        keys = [key for key in self._tracks if key[0] == Role.WHEEL_SPEEDS]
        if not keys:
            return np.full(len(edges) - 1, np.nan), np.zeros(len(edges) - 1, bool), np.zeros(len(edges) - 1, bool)
        means, there = zip(*(self._tracks[key].means(edges, known_to) for key in keys), strict=True)
        speed, contradicted = self._wheels.mean(np.array(means), [wheel for _, wheel in keys])
        return speed, np.any(there, axis=0), contradicted

    @property
    def _speed_keys(self) -> list[tuple[Role, int]]:
        """Keys of the tracks that speed is taken from."""
        role = Role.SPEED if Role.SPEED in self._bound else Role.WHEEL_SPEEDS
        return [key for key in self._tracks if key[0] == role]


def _horizons(ends: Floats) -> NDArray[np.int64]:
    """Index (k,) of the first row that is not complete at each of the times ``ends`` (k,) [s]."""
    horizons: NDArray[np.int64] = np.floor((ends - SETTLE) / STEP).astype(np.int64)
    return horizons


def between(readings: Readings, start: float, end: float) -> dict[Role, list[Series]]:
    """Readings in the half-open interval ``start`` to ``end`` [s], of the roles that have any in it."""
    cut = {role: [_part(series, start, end) for series in parts] for role, parts in readings.items()}
    return {role: parts for role, parts in cut.items() if any(len(part.t) for part in parts)}


def _part(series: Series, start: float, end: float) -> Series:
    low, high = np.searchsorted(series.t, [start, end])
    return Series(series.t[low:high], series.value[low:high])

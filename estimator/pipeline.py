"""The one way from frames to estimates, live, replayed or read from a log.

Frames are cut into blocks at fixed message times, so how they arrived - one by one or a million at once - changes
nothing that follows.
"""

from collections import Counter, deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from estimator.can_io.binding import bind, load_database
from estimator.can_io.decoder import Decoder
from estimator.can_io.frames import Frames
from estimator.config import Config
from estimator.errors import MissingInputsError
from estimator.estimate import Estimate
from estimator.estimation import engine_power
from estimator.estimation.alignment import Aligner
from estimator.estimation.estimator import Estimator
from estimator.samples import STEP, Rows
from estimator.signals import Role
from estimator.state import Count, State, read, substate

BLOCK = 5.0  # s of traffic decoded at a time
LONGEST_SILENCE = 30.0  # s without a frame after which the signals before and after are not joined
NEW_DRIVE = 900.0  # s without a frame after which the load may be another one: a new window
LONGEST_LIST = 1000  # gaps remembered
CLOCK_SET = 1_577_836_800.0  # s, start of 2020: a clock before it was never set, and tells no time away
BACKWARD = 0.1  # s a timestamp may step back, as gateways with several channels do


class Pipeline:
    """Decoder, aligner and estimator in a row, with the counts of what went through.

    ``tap`` is shown all rows on their way to the estimator.
    """

    def __init__(self, config: Config, tap: Callable[[Rows], object] | None = None) -> None:
        self._messages = bind(config, load_database(config.bus.dbc))
        self._names = {s.role: f"{m.name}.{s.signal.name}" for m in self._messages for s in m.signals}
        self._config = config
        self._decoder, self._aligner, self.estimator = self._rooms()
        self._tap = tap
        self.frames = 0
        self.valid_rows = 0  # with both speed and power
        self.seen: Counter[Role] = Counter()  # readings a role has given
        self.newest: dict[Role, float] = {}  # time of the newest valid one [s]
        self.gaps: deque[tuple[float, float]] = deque(maxlen=LONGEST_LIST)  # without speed or power, from and to [s]
        self._waiting: list[Frames] = []
        self._last: float | None = None  # time of the newest frame, None when all is finished with [s]
        self._until: float | None = None  # time of the newest frame ever [s]
        self._restored = False  # and not fed since
        self._same_clock = True  # since the state was saved
        self._block_end = 0.0

    def _rooms(self) -> tuple[Decoder, Aligner, Estimator]:
        config = self._config
        aligner = Aligner(config.vehicle, frozenset(self._names), config.kinematics.despike)
        return Decoder(self._messages), aligner, Estimator(config, np.random.default_rng(config.sampler.seed))

    @property
    def effects(self) -> tuple[str, ...]:
        """Names of the effects in the model."""
        return tuple(dict.fromkeys(self._config.effects))

    @property
    def used(self) -> int:
        """Frames that gave a signal."""
        return self._decoder.used

    @property
    def errors(self) -> Counter[str]:
        """Frames and values that were refused, by message, signal and reason."""
        return self._decoder.rejected + self._decoder.transport_rejected

    @property
    def sources(self) -> dict[str, int]:
        """Source address that each J1939 signal is taken from, by MESSAGE.signal."""
        return dict(self._decoder.sources)

    def feed(self, frames: Frames) -> Iterator[Estimate]:
        """Take the next frames in order of arrival; yields estimates as they fall due."""
        if not len(frames):
            return
        if self._restored:
            yield from self._resume(float(frames.t[0]))
        self.frames += len(frames)
        before = np.concatenate([[frames.t[0] if self._last is None else self._last], frames.t[:-1]])
        step = frames.t - before
        cuts = np.flatnonzero((step > LONGEST_SILENCE) | (step < -BACKWARD)).tolist()
        starts = sorted({0, *cuts})
        for start, stop in zip(starts, [*starts[1:], len(frames)], strict=True):
            if start in cuts:
                yield from self._interrupt(float(frames.t[start]))
            yield from self._continue(frames[start:stop])

    def finish(self) -> Iterator[Estimate]:
        """Use up what is still waiting, at the end of the traffic."""
        if self._last is None:
            return
        yield from self._flush(self._last)
        for rows in self._aligner.finish(self._last):
            self._watch(rows)
            yield from self.estimator.feed(rows)
        yield from self.estimator.finish()
        self._last = None

    def state(self) -> dict[str, Any]:
        """What `restore` goes on from; to be taken between two calls of `feed`, and instead of `finish`.

        Not in it are frames and readings that have not become rows yet, up to the last BLOCK + 3 s of traffic, nor
        what traffic shows again in seconds: how often each sender speaks. Arrays are not copied, but never changed.
        """
        return {
            "decoder": self._decoder.state(),
            "aligner": self._aligner.state(),
            "estimator": self.estimator.state(),
            "frames": self.frames,
            "valid_rows": self.valid_rows,
            "seen": {role.value: count for role, count in self.seen.items()},
            "gaps": list(self.gaps),
            "until": self._until,
        }

    def restore(self, state: State, same_clock: bool = True) -> None:
        """Go on where another pipeline with the same configuration was; before the first frame.

        The next frame shows for how long it was away. Up to NEW_DRIVE is a gap. After a longer time, when the clock
        was set back or never set, or when it is not the ``same_clock`` that has run on since, the load may be another
        one: what was known of the vehicle is carried over as after a long stop, and the sources of signals are found
        anew. Until then there is no estimate.

        Raises
        ------
        StateError
            The state does not fit; the pipeline is as it was before.
        """
        decoder, aligner, estimator = self._rooms()
        decoder.restore(substate(state, "decoder"))
        aligner.restore(substate(state, "aligner"))
        estimator.restore(substate(state, "estimator"))
        frames, valid_rows = read(state, "frames", Count), read(state, "valid_rows", Count)
        seen, gaps = read(state, "seen", dict[Role, Count]), read(state, "gaps", list[tuple[float, float]])
        self._until = read(state, "until", float | None)
        self._decoder, self._aligner, self.estimator = decoder, aligner, estimator
        self.frames, self.valid_rows, self.seen = frames, valid_rows, Counter(seen)
        self.gaps = deque(gaps, maxlen=LONGEST_LIST)
        self._restored, self._same_clock = True, same_clock

    @property
    def missing(self) -> list[str]:
        """Inputs that the model needs and that never came, by MESSAGE.signal."""
        return [self._names.get(role, role.value) for role in self._needed() if not self.seen[role]]

    def require_inputs(self, place: str) -> None:
        """Complain if the traffic so far cannot feed the model.

        Raises
        ------
        MissingInputsError
            A needed signal never came, or never with a valid value.
        """
        if missing := self.missing:
            there = sorted(self._names[role] for role in self.seen)
            raise MissingInputsError(
                f"{place}: missing inputs: {', '.join(missing)}; found: {', '.join(there) or 'none'}; "
                "bind what the bus carries in [signals] of the configuration"
            )
        if not self.valid_rows:
            counts = self.errors + self.estimator.rejected
            reasons = ", ".join(f"{reason} {count}" for reason, count in counts.most_common(4)) or "time stands still"
            raise MissingInputsError(f"{place}: not one moment with both speed and power valid: {reasons}")

    def _needed(self) -> list[Role]:
        needed = [Role.SPEED if Role.SPEED in self._names else Role.WHEEL_SPEEDS]
        if self._config.kinematics.acceleration == "inertial":
            needed.append(Role.LONGITUDINAL_ACCELERATION)
        return [*needed, *engine_power.needed(self._config.vehicle, self._names.keys())]

    def _continue(self, frames: Frames) -> Iterator[Estimate]:
        if self._last is None:
            self._block_end = float(frames.t[0]) + BLOCK
        self._last = self._until = float(frames.t[-1])
        while len(frames):
            beyond = np.flatnonzero(frames.t >= self._block_end)
            cut = int(beyond[0]) if len(beyond) else len(frames)
            self._waiting.append(frames[:cut])
            frames = frames[cut:]
            if len(beyond):
                yield from self._flush(self._block_end)
                self._block_end += BLOCK

    def _flush(self, now: float) -> Iterator[Estimate]:
        block = Frames.concatenate(self._waiting)
        self._waiting = []
        readings = self._decoder.decode(block)
        for role, parts in readings.items():
            self.seen[role] += sum(len(part.t) for part in parts)
            for part in parts:
                if (valid := np.isfinite(part.value)).any():
                    self.newest[role] = float(part.t[valid][-1])
        for rows in self._aligner.feed(readings, now):
            self._watch(rows)
            yield from self.estimator.feed(rows)

    def _watch(self, rows: Rows) -> None:
        """Count rows that could be used, and note for how long they could not."""
        if self._tap is not None:
            self._tap(rows)
        self.valid_rows += int((np.isfinite(rows.speed) & np.isfinite(rows.power)).sum())
        stale = np.concatenate([[False], ~rows.fresh.all(axis=1), [False]])
        edges = np.flatnonzero(np.diff(stale)).reshape(-1, 2)
        for start, end in ((rows.index[0] + edges) * STEP).tolist():
            if self.gaps and start - self.gaps[-1][1] < STEP:
                start = self.gaps.pop()[0]
            self.gaps.append((start, end))

    def _interrupt(self, t: float) -> Iterator[Estimate]:
        """Signals before and after a silence or a step in time are not joined; a long one starts a new window."""
        last = self._last
        assert last is not None
        yield from self.finish()
        self.gaps.append((last, t))
        if t < last:  # another recording, or the same one again
            self._aligner.forget()
        if not 0 <= t - last <= NEW_DRIVE:
            self.estimator.forget(vehicle=t < last)

    def _resume(self, t: float) -> Iterator[Estimate]:
        """Rows before and after the time away are not joined, however short it was."""
        self._restored = False
        if self._until is None:
            return
        self.gaps.append((self._until, t))
        same_load = self._same_clock and self._until >= CLOCK_SET and 0 <= t - self._until <= NEW_DRIVE
        if not same_load:
            self._decoder.release()
        yield from self.estimator.resume(same_load)

"""First stage of the pipeline: frames in, rows of one time grid out, live or from a log.

Frames are put in order of time and cut into blocks at fixed message times. The rows so do not depend on how the frames
arrived, one by one or a million at once.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from estimator.can_io.bound_traffic import bound_messages
from estimator.can_io.decoder import Decoder
from estimator.can_io.frames import Frames
from estimator.can_io.obd import current_data
from estimator.can_io.time_order import MAX_DELAY, TimeOrder
from estimator.checkpoint.validation import Count, State, read, substate
from estimator.config import Config
from estimator.errors import MissingInputsError
from estimator.road_map import RoadMap
from estimator.samples import Rows
from estimator.signals import REFERENCES, Floats, Role
from estimator.streaming.alignment import MAX_LINE, SPEEDS, Aligner, Readings, between
from estimator.streaming.course import MapGrade
from estimator.streaming.missing_inputs import advice, listed, needed, too_seldom
from estimator.streaming.references import References
from estimator.streaming.remarks import constant_friction, dropped_values
from estimator.streaming.resampling import block_bounds
from estimator.streaming.row_counts import Gap, RowCounts

BLOCK = 5.0  # s of traffic in which senders are judged, and whose rows are handed on together
MAX_BLOCKS = 1000  # decoded at once, 83 min: bounds the memory where frames are few
# s without a frame, after which rows begin anew. Twice `resampling.MAX_FRESH`, for which a reading counts at the
# longest: nothing that could be joined is cut.
MAX_SILENCE = 30.0
# s without a frame, after which another drive begins, with another load. Chosen by hand: a silence of `load.stop_s`,
# 300 s as shipped, is a stop already; a larger value would join drives that `diagnose` judges apart.
MIN_NEW_DRIVE_SILENCE = 900.0
# Roles whose readings are joined by straight lines; the constants that power is computed from come seldom.
LINES = frozenset({Role.SPEED, Role.WHEEL_SPEEDS, Role.ENGINE_POWER, Role.ENGINE_TORQUE, Role.TORQUE_FRACTION})
MIN_INTERVALS, MAX_FIRST = 3, 100  # readings that show how often a signal comes
NO_TIMES = np.empty(0)
# Before it a clock is not set, and the downtime unknown. Clocks that were never set start in 1970 (POSIX), in 1980
# (GPS), or on the first day of 2000 or 2010 (usual defaults of real-time clocks).
MIN_SET_CLOCK = 1_293_840_000.0  # s, start of 2011


@dataclass(frozen=True, slots=True)
class Block:
    """Stretch of traffic with its frames in order of time, and the rows that it completed.

    ``decoded`` are the readings of all blocks that were decoded together, and ``span`` the times [s] of this one.
    """

    frames: Frames
    rows: tuple[Rows, ...]
    decoded: Readings
    span: tuple[float, float]

    @property
    def readings(self) -> Readings:
        """Readings of this block."""
        return between(self.decoded, *self.span)


@dataclass(frozen=True, slots=True, kw_only=True)
class Interruption:
    """Silence, or step in time, from ``start`` to ``end`` [s]; rows are not joined across it.

    After a ``is_new_drive`` interruption the load may be another one. With ``is_step_back`` the vehicle may be another
    one as well, and after ``is_sender_replaced`` the estimates of the vehicle may be wrong. It lasted ``hidden`` [s]
    longer than its times say.
    """

    start: float | None  # None: a state without traffic was restored
    end: float
    is_new_drive: bool
    is_sender_replaced: bool = False
    hidden: float = 0.0

    @property
    def is_step_back(self) -> bool:
        """True if time was set back: another recording, or the same one again."""
        return self.start is not None and self.end < self.start


class RowStream:
    """Turns frames into rows by a decoder and an aligner.

    Attributes
    ----------
    order : TimeOrder
        Puts frames in order; counts those that came late and those without a usable time.
    frames : int
        Frames fed.
    start : float or None
        Time of the first frame [s].
    rows : RowCounts
        Counts of the rows, and the times without speed or power.
    seen : collections.Counter[Role]
        Readings by role.
    newest : dict[Role, float]
        Time of the newest valid reading [s], by role.
    replacements : int
        Number of senders replaced by others; window and vehicle are discarded at each.
    references : References
        Estimates of other control units, which the rows do not have.
    """

    def __init__(self, config: Config) -> None:
        self._messages = bound_messages(config)
        self._names = {s.role: f"{m.name}.{s.signal.name}" for m in self._messages for s in m.signals}
        self._config = config
        self._decoder, self._aligner = self._new()
        # A grade signal that is bound counts for more than a map.
        path = None if Role.GRADE in self._names else config.road.map
        self._map = None if path is None else MapGrade(RoadMap.read(Path(path)))
        self.order = TimeOrder()
        self.frames = 0
        self.start: float | None = None
        self.rows = RowCounts()
        self.seen: Counter[Role] = Counter()
        self.newest: dict[Role, float] = {}
        self.replacements = 0
        self.references = References(self._names)
        self._lines = LINES & frozenset(self._names)
        self._first: dict[Role, Floats] = {}  # times [s] of the first readings
        self._answers = 0  # to OBD-II requests, while nothing else was of use
        self._waiting: list[Frames] = []
        self._last: float | None = None  # time of the newest frame, None when all frames have become rows [s]
        self._until: float | None = None  # time of the newest frame ever [s]
        self._is_restored = False  # and not fed since
        self._same_clock = True  # since the state was saved
        self._now: float | None = None  # of `feed` [s]
        self._fed: float | None = None  # `now` of the newest frames [s], also of those before a restored state
        self._block_end = 0.0

    def _new(self) -> tuple[Decoder, Aligner]:
        config = self._config
        speeds = [s for m in self._messages for s in m.signals if s.role in SPEEDS and not s.signal.is_float]
        step = max((abs(s.signal.scale * s.conversion.scale) for s in speeds), default=0.0)
        aligner = Aligner(config.vehicle, frozenset(self._names) - REFERENCES, config.kinematics.despike, step)
        return Decoder(self._messages, config.bus), aligner

    @property
    def until(self) -> float | None:
        """Time of the newest frame [s], including those before a restored state."""
        return self._until

    @property
    def is_restored(self) -> bool:
        """True from a restore until the first frames are in order, which show whether the load is another."""
        return self._is_restored

    @property
    def used(self) -> int:
        """Frames that gave a signal."""
        return self._decoder.used

    @property
    def errors(self) -> Counter[str]:
        """Frames and values that were refused, by message, signal and reason."""
        refused = self._decoder.rejected + self._decoder.transport_rejected
        return refused + self.order.refused + self._aligner.refused

    @property
    def remarks(self) -> list[str]:
        """Remarks on probable errors of the database, one line each."""
        return [
            *dropped_values(self._messages, self.errors, self.seen),
            *self.rows.switches.remarks(self._names),
            *constant_friction(self._aligner.constant_friction, self._names),
        ]

    @property
    def sources(self) -> dict[str, int]:
        """Chosen source address of each J1939 signal, by MESSAGE.signal."""
        return dict(self._decoder.sources)

    @property
    def reference_torque(self) -> float | None:
        """Newest reference torque of the engine [N m] that the bus sent."""
        return self._aligner.reference_torque

    @property
    def contested(self) -> dict[str, str]:
        """Inputs that are contested now: reason by MESSAGE.signal."""
        return dict(self._decoder.contested)

    @property
    def missing(self) -> list[str]:
        """Inputs of the model without a reading so far, by MESSAGE.signal."""
        return [self._names.get(role, role.value) for role in self._missing_roles()]

    def feed(self, frames: Frames, now: float | None = None) -> Iterator[Block | Interruption]:
        """Take the next frames in order of arrival; yields blocks, and interruptions between them.

        A frame waits for MAX_DELAY of traffic, until no other can precede it. ``now`` [s], of a clock that is never
        set, tells the downtime before a restored state, where message times may hide some of it.
        """
        self._now = now
        self.frames += len(frames)
        if not self.used:
            self._answers += current_data(frames)
        for ordered in self.order.feed(frames):
            yield from self._process(ordered)
        if not self._is_restored:
            self._fed = now

    def finish(self) -> Iterator[Block | Interruption]:
        """Turn the waiting frames into rows, at the end of the traffic."""
        yield from self._process(self.order.finish())
        yield from self._end()

    def feed_all(self, batches: Iterable[Frames]) -> Iterator[Block | Interruption]:
        """Take all ``batches`` of frames, and finish."""
        for frames in batches:
            yield from self.feed(frames)
        yield from self.finish()

    def require_inputs(self, source: str) -> None:
        """Check that the traffic so far has all inputs of the model.

        Raises
        ------
        MissingInputsError
            A needed signal never came, never with a valid value, or too seldom to be used.
        """
        if not self.frames:
            if self._config.table is not None:
                raise MissingInputsError(f"{source}: has no row; give one with speed and power")
            checks = "check the bit rate, the wiring and the filters"
            if any(message.of_any_ecu for message in self._messages):
                checks += f"; {advice(self._missing_roles(), (), self._messages, 0, self._config)}"
            raise MissingInputsError(f"{source}: no frame came; {checks}")
        if not self.rows.valid and (reason := self._too_seldom()):
            raise MissingInputsError(f"{source}: {reason}")
        if missing := self._missing_roles():
            lacking = listed(missing, self._names, self._config)
            if names := self._decoder.sent_by_others:
                raise MissingInputsError(
                    f"{source}: missing inputs: {lacking}; the group of {', '.join(names)} is sent "
                    "with another priority or address than in the DBC, which does not say that it is of J1939 "
                    '(VFrameFormat): write [bus] match = "pgn" into the configuration'
                )
            there = ", ".join(sorted(self._names[role] for role in self.seen)) or "none"
            remedy = advice(missing, self.seen, self._messages, self._answers, self._config)
            raise MissingInputsError(f"{source}: missing inputs: {lacking}; {remedy}; found: {there}")
        if not self.rows.valid:
            counts = (self.errors + self.rows.unusable).most_common(4)
            reasons = ", ".join(f"{reason} {count}" for reason, count in counts) or "time stands still"
            raise MissingInputsError(f"{source}: not one moment with both speed and power valid: {reasons}")

    def state(self) -> dict[str, Any]:
        """State for `restore`; to be taken between two calls of `feed`, and instead of `finish`.

        It lacks frames and readings that have not become rows yet: up to the last BLOCK + 4 s of traffic, and 10 s of
        constant speed and power. It also lacks the periods of senders, which traffic shows again in seconds. Arrays are
        not copied, but never changed.
        """
        return {
            "decoder": self._decoder.state(),
            "aligner": self._aligner.state(),
            "frames": self.frames,
            "valid_rows": self.rows.valid,
            "seen": {role.value: count for role, count in self.seen.items()},
            "gaps": list(self.rows.gaps),
            "until": self._until,
            "fed": self._fed,
            "replacements": self.replacements,
        }

    def restore(self, state: State, same_clock: bool = True) -> None:
        """Take the state of another stream with the same configuration, before the first frame.

        The first item that `feed` then yields is an interruption. It begins a new drive after a downtime of more than
        MIN_NEW_DRIVE_SILENCE, or of unknown length; the senders of signals are then chosen again. The length is unknown
        if the clock was set back to before the state, was never set, or has not run since (``same_clock`` is False).

        Raises
        ------
        StateError
            The state does not fit; the stream is as it was before.
        """
        decoder, aligner = self._new()
        decoder.restore(substate(state, "decoder"))
        aligner.restore(substate(state, "aligner"))
        frames, valid_rows = read(state, "frames", Count), read(state, "valid_rows", Count)
        seen, gaps = read(state, "seen", dict[Role, Count]), read(state, "gaps", list[Gap])
        until, fed = read(state, "until", float | None), read(state, "fed", float | None)
        self.replacements = read(state, "replacements", Count)
        self._until, self._fed = until, fed
        self._decoder, self._aligner = decoder, aligner
        self.frames, self.rows, self.seen = frames, RowCounts(valid_rows, gaps), Counter(seen)
        self._is_restored, self._same_clock = True, same_clock

    def _too_seldom(self) -> str:
        """Reason why a needed input comes too seldom to be used; empty if none does."""
        intervals = {role: float(np.median(np.diff(t))) for role, t in self._first.items() if len(t) > MIN_INTERVALS}
        longest = max(intervals, key=intervals.__getitem__, default=None)
        return "" if longest is None else too_seldom(self._names[longest], intervals[longest], MAX_LINE)

    def _missing_roles(self) -> list[Role]:
        return [role for role in needed(self._config.vehicle, self._names.keys()) if not self.seen[role]]

    def _process(self, frames: Frames) -> Iterator[Block | Interruption]:
        """Process frames in order of time, with an interruption at each silence or step in time."""
        if not len(frames):
            return
        if self.start is None:
            self.start = float(frames.t[0])
        if self._is_restored:
            yield self._resume(float(frames.t[0]))
        step = np.diff(frames.t, prepend=frames.t[0] if self._last is None else self._last)
        cuts = np.flatnonzero((step > MAX_SILENCE) | (step < -MAX_DELAY)).tolist()
        starts = sorted({0, *cuts})
        for start, stop in zip(starts, [*starts[1:], len(frames)], strict=True):
            if start in cuts:
                yield from self._interrupt(float(frames.t[start]))
            yield from self._continue(frames[start:stop])

    def _continue(self, frames: Frames) -> Iterator[Block | Interruption]:
        if self._last is None:
            self._block_end = float(frames.t[0]) + BLOCK
        self._last = self._until = float(frames.t[-1])
        while len(frames):
            ends = self._ends_before(float(frames.t[-1]))
            cut = int(np.searchsorted(frames.t, ends[-1])) if len(ends) else len(frames)
            self._waiting.append(frames[:cut])
            frames = frames[cut:]
            if len(ends):
                yield from self._blocks(ends)

    def _ends_before(self, t: float) -> Floats:
        """Ends (k,) [s] of the next blocks, at most MAX_BLOCKS, that traffic up to time ``t`` [s] completes."""
        count = min(int(max(t - self._block_end, 0.0) / BLOCK) + 2, MAX_BLOCKS)
        ends = np.cumsum([self._block_end, *[BLOCK] * (count - 1)])
        return ends[ends <= t]

    def _end(self) -> Iterator[Block | Interruption]:
        """Yield the last block before an interruption or the end of the traffic, with all rows still waiting."""
        if self._last is None:
            return
        now, self._last = self._last, None
        for item in self._blocks(np.array([now])):
            if isinstance(item, Block):
                rest = tuple(self._with_grade(rows) for rows in self._aligner.finish(now))
                silences = self.rows.silences(rest)
                self.rows.add(rest, self._aligner.silent)
                self.rows.pause()
                if silences:
                    yield item
                    yield _silence(*silences[0])
                    item = Block(item.frames[:0], (), item.decoded, (now, now))
                yield replace(item, rows=(*item.rows, *rest))
            else:
                yield item

    def _blocks(self, ends: Floats) -> Iterator[Block | Interruption]:
        """Yield the blocks of waiting frames that end at ``ends`` (k,) [s], and interruptions before them."""
        frames, self._waiting = Frames.concatenate(self._waiting), []
        bounds = block_bounds(frames.t, ends).tolist()
        for decoded in self._decoder.decode_blocks(frames, ends):
            self._note_readings(decoded.readings)
            if self._decoder.replaced:
                yield self._replace(float(decoded.ends[0]))
            self._block_end = float(decoded.ends[-1]) + BLOCK
            parts = self._aligner.feed_blocks(self.references.take(decoded.readings), decoded.ends)
            rows = [None if part is None else self._with_grade(part) for part in parts]
            silences = self.rows.silences(rows)
            self.rows.add([part for part in rows if part is not None], self._aligner.silent)
            edges = [-np.inf, *decoded.ends[:-1].tolist(), np.inf]
            first = 0  # block of those that are handed on with the next rows
            for i, part in enumerate(rows):
                if part is None and i + 1 < len(rows):
                    continue
                if i in silences:
                    yield _silence(*silences[i])
                low, high, span = bounds[first], bounds[i + 1], (edges[first], edges[i + 1])
                yield Block(frames[low:high], () if part is None else (part,), decoded.readings, span)
                first = i + 1
            del bounds[: len(rows)]

    def _with_grade(self, rows: Rows) -> Rows:
        """Return the rows, with the slope of the map if there is a map."""
        return rows if self._map is None else self._map.feed(rows)

    def _replace(self, end: float) -> Interruption:
        """Drop the waiting rows and the engine's constants, which may come from a wrong sender.

        The interruption is the block up to ``end`` [s]. It may have no frame: a contest also ends in silence.
        """
        self.replacements += 1
        for _ in self._aligner.finish(end):
            pass
        self.rows.pause()
        self._aligner.forget()
        return Interruption(start=self._block_end - BLOCK, end=end, is_new_drive=True, is_sender_replaced=True)

    def _note_readings(self, readings: Readings) -> None:
        """Count readings, and keep the time of the newest valid one of each role."""
        for role, parts in readings.items():
            self.seen[role] += sum(len(part.t) for part in parts)
            if role in self._lines and len(first := self._first.get(role, NO_TIMES)) < MAX_FIRST:
                self._first[role] = np.append(first, parts[0].t)[:MAX_FIRST]
            for part in parts:
                if (valid := np.isfinite(part.value)).any():
                    self.newest[role] = float(part.t[valid][-1])

    def _interrupt(self, t: float) -> Iterator[Block | Interruption]:
        """Finish the rows before a silence or a step in time to ``t`` [s]; signals are not joined across it."""
        last = self._last
        assert last is not None
        yield from self._end()
        self.rows.gaps.append((last, t))
        interruption = Interruption(start=last, end=t, is_new_drive=not 0 <= t - last <= MIN_NEW_DRIVE_SILENCE)
        if interruption.is_step_back:
            self._aligner.forget()
            self._decoder.release(is_other_vehicle=True)
        yield interruption

    def _resume(self, t: float) -> Interruption:
        """Return the interruption of a downtime that ends at ``t`` [s]; rows are not joined across it."""
        self._is_restored = False
        last = self._until
        if last is None:
            return Interruption(start=None, end=t, is_new_drive=True)
        self.rows.gaps.append((last, t))
        gap = away = t - last
        if self._now is not None and self._fed is not None:
            away = max(gap, self._now - self._fed)
        same_load = self._same_clock and last >= MIN_SET_CLOCK and 0 <= gap <= away <= MIN_NEW_DRIVE_SILENCE
        if not same_load:
            self._decoder.release()
        return Interruption(start=last, end=t, is_new_drive=not same_load, hidden=away - gap if same_load else 0.0)


def _silence(start: float, end: float) -> Interruption:
    """Interruption in which speed and power were not read."""
    return Interruption(start=start, end=end, is_new_drive=end - start > MIN_NEW_DRIVE_SILENCE)

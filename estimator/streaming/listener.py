"""Processing loop on a bus, in message time: messages in, broadcasts out; for daemon, replay and `can.Notifier`."""

from collections import Counter, deque
from collections.abc import Callable
from contextlib import AbstractContextManager
from types import TracebackType
from typing import Protocol

import can
import numpy as np

from estimator.can_io.frames import Frames
from estimator.can_io.publisher import Publisher
from estimator.can_io.time_order import MAX_DELAY, NO_TIME, is_time
from estimator.config import Config
from estimator.errors import RoadloadError
from estimator.estimates import Estimate, Slope
from estimator.estimation.road_now import RoadAhead
from estimator.settings import Publish
from estimator.streaming.pipeline import Pipeline
from estimator.streaming.row_stream import MIN_NEW_DRIVE_SILENCE

TICK = 0.25  # s of traffic taken at a time; well below the shortest period of the broadcasts
MAX_UPDATES = 10_000  # kept: a week of them
UNSTAMPED = "no time stamp (0 s)"

Send = Callable[[can.Message], object]
Broadcast = Callable[[float, Estimate | None, Slope | None], object]


class Worker(Protocol):
    """Interface of an estimator of frames: in the caller's thread (`InlineWorker`), or in a thread of the daemon."""

    @property
    def latest(self) -> Estimate | None:
        """The newest estimate; None before the first."""

    @property
    def heard(self) -> float | None:
        """Message time [s] of the newest frame that `latest` takes into account."""

    @property
    def rows_until(self) -> float | None:
        """Message time [s] to which speed or power was read; None before the first, and after an interruption."""

    @property
    def load_until(self) -> float:
        """Message time [s] from which on the load may be another than that of `latest`."""

    @property
    def road_now(self) -> RoadAhead | None:
        """The road under the vehicle; None while it is not known."""

    def offer(self, frames: Frames) -> None:
        """Take the next frames."""

    def close(self) -> None:
        """Use the frames still waiting, at the end of the traffic."""


class InlineWorker:
    """Estimates in the caller's thread; keeps the newest MAX_UPDATES ``updates``."""

    def __init__(self, config: Config) -> None:
        self.pipeline = Pipeline(config, is_live=True)
        self.updates: deque[Estimate] = deque(maxlen=MAX_UPDATES)

    @property
    def latest(self) -> Estimate | None:
        """The newest estimate; None before the first."""
        return self.pipeline.latest

    @property
    def heard(self) -> float | None:
        """Message time [s] of the newest frame that `latest` takes into account."""
        return self.pipeline.traffic.until

    @property
    def rows_until(self) -> float | None:
        """Message time [s] to which speed or power was read; None before the first, and after an interruption."""
        return self.pipeline.traffic.rows.until

    @property
    def load_until(self) -> float:
        """Message time [s] from which on the load may be another than that of `latest`."""
        return self.pipeline.load_until

    @property
    def road_now(self) -> RoadAhead | None:
        """The road under the vehicle; None while it is not known."""
        return self.pipeline.road_now

    def offer(self, frames: Frames) -> None:
        """Take the next frames, and estimate when it is due."""
        self.updates += self.pipeline.feed(frames)

    def close(self) -> None:
        """Use the frames still waiting, at the end of the traffic."""
        self.updates += self.pipeline.finish()


def broadcast_by(publish: Publish, send: Send) -> Broadcast:
    """Return a broadcast that calls ``send`` with each message that is due; it claims no address."""
    publisher = Publisher(publish)

    def broadcast(t: float, estimate: Estimate | None, slope: Slope | None) -> None:
        for message in publisher.poll(t, estimate, slope):
            send(message)

    return broadcast


class Listener(can.Listener, AbstractContextManager["Listener"]):
    """python-can listener that hands frames to a worker, and the worker's estimates to a broadcast.

    Leaving its context stops it, and raises the first error of the bus.

    Parameters
    ----------
    worker
        Estimates from the frames.
    broadcast
        Called with the message time [s], the newest estimate and the slope, at least every TICK of traffic.
    is_log
        True if the time 0 s is one, as where a log begins; from a bus, python-can gives it to messages without a stamp.

    Attributes
    ----------
    skipped : collections.Counter[str]
        Messages that are no data frames, or without a usable time, by reason.
    failure : Exception or None
        The first error of the bus under a `can.Notifier`.
    failures : int
        Errors of the bus under a `can.Notifier`.
    """

    def __init__(self, worker: Worker, broadcast: Broadcast, is_log: bool = False) -> None:
        self.skipped: Counter[str] = Counter()
        self.failure: Exception | None = None
        self.failures = 0
        self._worker, self._broadcast, self._is_log = worker, broadcast, is_log
        self._waiting: list[can.Message] = []
        self._due: float | None = None
        self._newest = worker.heard  # message time [s]
        self._woken = -np.inf  # message time [s] after which the load is the present one

    @classmethod
    def of(cls, config: Config, send: Send) -> "Listener":
        """Return a listener that estimates in the caller's thread and puts broadcasts on a bus by ``send``."""
        return cls(InlineWorker(config), broadcast_by(config.publish, send))

    @property
    def latest(self) -> Estimate | None:
        """The newest estimate; None before the first."""
        return self._worker.latest

    def hear(self, frames: Frames) -> None:
        """Take frames in order of arrival."""
        if len(frames):
            steps = np.diff(frames.t, prepend=frames.t[0] if self._newest is None else self._newest)
            new = np.flatnonzero((steps > MIN_NEW_DRIVE_SILENCE) | (steps < -MAX_DELAY))
            self._woken = float(frames.t[new[-1]]) if len(new) else self._woken
            self._newest = float(frames.t[-1])
        self._worker.offer(frames)

    def fresh(self, t: float) -> Estimate | None:
        """The newest estimate at message time ``t`` [s]; None where the load may have changed since it.

        The load may change in a stop of `load.stop_s`, and in a silence above MIN_NEW_DRIVE_SILENCE, also where other
        frames go on coming. A step back in time means another recording, perhaps of another vehicle. The worker
        notices all three later than this loop.
        """
        # In this order: in another thread, the worker may conclude between the two.
        load_until, rows_until, estimate = self._worker.load_until, self._worker.rows_until, self.latest
        is_silent = self._newest is not None and t - self._newest > MIN_NEW_DRIVE_SILENCE
        if rows_until is not None and t - rows_until > MIN_NEW_DRIVE_SILENCE:
            self._woken = t
        if estimate is None or is_silent or t >= load_until or not self._woken <= estimate.t <= t + MAX_DELAY:
            return None
        return estimate

    def slope(self, t: float) -> Slope | None:
        """Slope of the road under the vehicle at message time ``t`` [s]; None if unknown."""
        load_until, road = self._worker.load_until, self._worker.road_now
        return None if road is None or t >= load_until or road.t < self._woken else road.at(t)

    def turn(self, t: float) -> None:
        """Broadcast what is due at message time ``t`` [s]."""
        self._broadcast(t, self.fresh(t), self.slope(t))

    def on_message_received(self, msg: can.Message) -> None:
        """Take one message; after each TICK of message time, process the waiting messages and broadcast."""
        if msg.is_error_frame or msg.is_remote_frame:
            self.skipped["error frame" if msg.is_error_frame else "remote frame"] += 1
            return
        t = msg.timestamp
        if not is_time(t) or (t == 0 and not self._is_log):
            self.skipped[UNSTAMPED if t == 0 else NO_TIME] += 1
            return
        if self._due is None:
            self._due = t + TICK
        self._waiting.append(msg)
        # A frame may come late; a time still earlier means that the clock was set back.
        if t >= self._due or t < self._due - TICK - MAX_DELAY:
            self._due = t + TICK
            self._hear_waiting()
            self.turn(t)

    def on_error(self, exc: Exception) -> None:
        """Keep an error of the bus; the `can.Notifier` continues to read."""
        self.failures += 1
        if self.failure is None:
            self.failure = exc

    def stop(self) -> None:
        """Process the messages still waiting at the end of the traffic, and broadcast the conclusion once.

        A broadcast that fails is noted as an error of the bus.
        """
        if self._due is None:
            return
        end = self._waiting[-1].timestamp if self._waiting else self._due - TICK
        self._due = None
        self._hear_waiting()
        self._worker.close()
        try:
            self.turn(end + TICK)
        except (can.CanError, OSError) as error:
            self.on_error(error)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Stop.

        Raises
        ------
        RoadloadError
            The bus failed, and no other exception is on its way.
        """
        self.stop()
        if error is None and self.failure is not None:
            times = f" {self.failures} times" if self.failures > 1 else ""
            raise RoadloadError(f"the bus failed{times}: {self.failure}") from self.failure

    def _hear_waiting(self) -> None:
        waiting, self._waiting = self._waiting, []
        self.hear(Frames.from_messages(waiting))

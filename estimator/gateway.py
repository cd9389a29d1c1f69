"""The loop on a bus: messages in, broadcasts out, in message time. Live traffic and replay share it."""

from collections import Counter, deque
from collections.abc import Callable

import can

from estimator.can_io.frames import Frames
from estimator.can_io.publisher import Publisher
from estimator.config import Config
from estimator.estimate import Estimate
from estimator.pipeline import Pipeline

TICK = 0.25  # s of traffic taken at a time; well below the shortest period of what is broadcast
LONGEST_LIST = 10_000  # updates remembered: a week of them


class Gateway(can.Listener):
    """A python-can listener that estimates from what it hears and sends what it concludes.

    Parameters
    ----------
    config
        All settings.
    send
        Puts a message on the output bus.
    """

    def __init__(self, config: Config, send: Callable[[can.Message], None]) -> None:
        self.pipeline = Pipeline(config)
        self.updates: deque[Estimate] = deque(maxlen=LONGEST_LIST)
        self.skipped: Counter[str] = Counter()
        self.sent: Counter[int] = Counter()  # messages broadcast, by arbitration id
        self._publisher = Publisher(config.publish)
        self._send = send
        self._waiting: list[can.Message] = []
        self._due: float | None = None

    def on_message_received(self, msg: can.Message) -> None:
        """Take one message; every TICK of message time, work through those that waited."""
        if msg.is_error_frame or msg.is_remote_frame:
            self.skipped["error frame" if msg.is_error_frame else "remote frame"] += 1
            return
        t = msg.timestamp
        if self._due is None:
            self._due = t + TICK
        self._waiting.append(msg)
        # A time far below what is due means that the clock was set back.
        if t >= self._due or t < self._due - 2 * TICK:
            self._tick(t)
            self._due = t + TICK

    def stop(self) -> None:
        """Use up what is still waiting at the end of the traffic, and broadcast the conclusion."""
        if not self._waiting and self._due is None:
            return
        end = self._waiting[-1].timestamp if self._waiting else (self._due or 0.0) - TICK
        self.updates += self.pipeline.feed(Frames.from_messages(self._waiting))
        self._waiting = []
        self.updates += self.pipeline.finish()
        self._broadcast(end + TICK)

    def _tick(self, t: float) -> None:
        self.updates += self.pipeline.feed(Frames.from_messages(self._waiting))
        self._waiting = []
        self._broadcast(t)

    def _broadcast(self, t: float) -> None:
        for message in self._publisher.poll(t, self.pipeline.estimator.latest):
            self._send(message)
            self.sent[message.arbitration_id] += 1

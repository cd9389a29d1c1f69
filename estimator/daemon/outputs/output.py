"""Another program that gets the estimate, served by a thread of its own: it may be slow, refuse, or be gone for weeks.

The daemon's loop leaves its newest report here and goes on. Only that one waits; what could not be sent while the
other side was away is not sent later.
"""

import logging
import threading
from collections import Counter
from collections.abc import Callable
from enum import StrEnum
from typing import Protocol

import numpy as np
from msgspec.structs import replace

from estimator.answers.published import PublishedAnswer
from estimator.answers.status import Output as OutputStatus
from estimator.daemon.reception.uptime import asleep, since_start
from estimator.errors import RoadloadError

log = logging.getLogger(__name__)

WAIT = 1.0  # s for a report, between two looks at the connection
MIN_PAUSE, MAX_PAUSE = 1.0, 60.0  # s before another attempt to connect: doubled each time
MAX_DELAY = 5.0  # s for which a report may wait: beyond, it is dropped
MIN_SLEEP = 0.5  # s of suspension after which a connection counts as lost
FAREWELL = 3.0  # s for the last messages when the daemon stops


class Trouble(StrEnum):
    """Kinds of failures."""

    UNREACHABLE = "not reached"
    REFUSED = "refused"
    TIMED_OUT = "timed out"
    LOST = "connection lost"
    SUSPENDED = "machine was suspended"
    GARBAGE = "not understood"


class OutputError(RoadloadError):
    """The other side cannot be reached, refuses, or does not answer; tried again later."""

    def __init__(self, trouble: Trouble, problem: str) -> None:
        super().__init__(problem)
        self.trouble = trouble


class Channel(Protocol):
    """A connection to another program; used by one thread, each call takes some seconds at most.

    Every method but `close` raises OutputError, and leaves it to the caller to `close`.
    """

    address: str

    def open(self) -> None:
        """Connect."""

    def attend(self) -> None:
        """Read what has come, and keep the connection alive."""

    def send(self, report: PublishedAnswer) -> bool:
        """Send a report; False where the one before is still on its way."""

    def withdraw(self, timeout: float) -> None:
        """Take back what was sent, for the daemon stops; takes ``timeout`` [s] at most."""

    def close(self) -> None:
        """Leave the connection, in whatever state it is."""


class Output:
    """Sends reports over a channel: a new conclusion or status at once, the rest every ``period`` [s].

    Parameters
    ----------
    rng
        Spreads attempts to connect, so that a fleet does not return to a broker in the same instant.
    clock, slept
        Time since the machine was started, and how much of it the machine was suspended [s].
    """

    def __init__(
        self,
        channel: Channel,
        period: float,
        rng: np.random.Generator,
        clock: Callable[[], float] = since_start,
        slept: Callable[[], float] = asleep,
    ) -> None:
        self.connections = self.sent = 0
        self.failed: Counter[Trouble] = Counter()
        self.problem = ""
        self.is_open = False
        self._channel, self._period, self._rng, self._clock, self._slept = channel, period, rng, clock, slept
        self._condition = threading.Condition()
        self._newest: tuple[PublishedAnswer, float] | None = None  # and when it was offered [s]
        self._stopped = False
        self._pause = MIN_PAUSE
        self._next_attempt = self._opened_at = -float("inf")
        self._slept_before = 0.0  # [s] when the channel was opened
        self._last: tuple[PublishedAnswer, float] | None = None  # what was sent last, and when [s]
        self._thread: threading.Thread | None = None

    def offer(self, report: PublishedAnswer) -> None:
        """Leave a report; it replaces one that still waits."""
        with self._condition:
            self._newest = report, self._clock()
            self._condition.notify()

    def status(self) -> OutputStatus:
        """State and counts."""
        return OutputStatus(
            address=self._channel.address,
            connected=self.is_open,
            problem=self.problem,
            connections=self.connections,
            sent=self.sent,
            failed={trouble.value: count for trouble, count in list(self.failed.items())},
        )

    def start(self) -> None:
        """Send in a thread from now on."""
        self._thread = threading.Thread(target=self._run, name=f"output {self._channel.address}", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Have the thread withdraw what was sent, and end."""
        with self._condition:
            self._stopped = True
            self._condition.notify()

    def close(self) -> None:
        """Wait for the thread, twice as long as it has for its last messages; one that hangs is left behind."""
        self.stop()
        if self._thread is not None:
            self._thread.join(2 * FAREWELL)

    def step(self, timeout: float = WAIT) -> None:
        """Connect, attend to the connection or send, whichever is due."""
        try:
            if not self.is_open:
                if self._clock() < self._next_attempt:
                    self._sleep(min(timeout, self._next_attempt - self._clock()))
                    return
                self._open()
            report = self._take(timeout)
            if self._slept() - self._slept_before > MIN_SLEEP:
                raise OutputError(Trouble.SUSPENDED, "the machine was suspended")
            self._channel.attend()
            if report is not None:
                self._send(report)
        except OutputError as error:
            self._give_up(error.trouble, str(error))
        except Exception as error:  # of any kind: what the other side sends decides what its library stumbles over
            self._give_up(Trouble.GARBAGE, f"not understood: {error!r}")

    def _run(self) -> None:
        while not self._stopped:
            self.step()
        if self.is_open:
            try:
                self._channel.withdraw(FAREWELL)
            except Exception as error:  # of any kind, as in a step; the daemon stops in any case
                log.warning("%s: the estimate was not withdrawn: %r", self._channel.address, error)
        self._channel.close()

    def _sleep(self, timeout: float) -> None:
        with self._condition:
            if not self._stopped:
                self._condition.wait(timeout)

    def _take(self, timeout: float) -> PublishedAnswer | None:
        """The newest report, waited for; None where there is none, or where it has waited too long."""
        with self._condition:
            if self._newest is None and not self._stopped:
                self._condition.wait(timeout)
            newest, self._newest = self._newest, None
        if newest is None or self._clock() - newest[1] > MAX_DELAY:
            return None
        return newest[0]

    def _open(self) -> None:
        self._slept_before = self._slept()
        self._channel.open()
        self.is_open, self._last, self._opened_at = True, None, self._clock()
        self.connections += 1
        log.info("%s: connected", self._channel.address)

    def _send(self, report: PublishedAnswer) -> None:
        now, content = self._clock(), _apart_from_time(report)
        if self._last is not None and self._last[0] == content and now - self._last[1] < self._period:
            return
        if self._channel.send(report):
            self._last = content, now
            self.sent += 1
            self.problem = ""

    def _give_up(self, trouble: Trouble, problem: str) -> None:
        """Close the channel, and wait before the next attempt: longer each time, unless it was open for long."""
        now = self._clock()
        if self.is_open and now - self._opened_at > MAX_PAUSE:
            self._pause = MIN_PAUSE
        if trouble is Trouble.SUSPENDED:
            self._pause = 0.0
        self._next_attempt = now + self._pause * self._rng.uniform(0.5, 1.0)
        self._pause = min(max(MIN_PAUSE, 2 * self._pause), MAX_PAUSE)
        self.failed[trouble] += 1
        if problem != self.problem or self.is_open:
            log.warning("%s: %s; tried again until it works", self._channel.address, problem)
        self.problem, self.is_open = problem, False
        self._channel.close()


def _apart_from_time(report: PublishedAnswer) -> PublishedAnswer:
    """The report without what changes from second to second."""
    estimate = None if report.estimate is None else replace(report.estimate, age_s=0.0)
    return replace(report, written_s=0.0, estimate=estimate)

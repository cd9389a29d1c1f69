"""One bus, for years: opened when it is there, drained by a thread of its own, opened anew when it has gone.

The thread does nothing but drain, so that nothing which computes can make the kernel drop frames. What it drains
waits in a bounded queue; when that is full the newest frames are dropped, as the kernel does, and counted.
"""

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace

import can
import numpy as np
from can.typechecking import CanFilter

from estimator.can_io.frames import EXTENDED, Frames
from estimator.config import Reception
from estimator.daemon.buses import BusSpec, Device, NotThereError, Probe, open_bus, probe_of
from estimator.daemon.reader import Batch, Reader, reader_of
from estimator.errors import ConfigError

log = logging.getLogger(__name__)

SHORTEST_WAIT, LONGEST_WAIT = 1.0, 30.0  # s between attempts to open a bus
PROBE_PERIOD = 1.0  # s between looks at the network device
READ_TIMEOUT = 0.2  # s
MOST_ECHOES = 100  # frames of our own that may still come back
BUS_OFF_WAIT = 2.0  # s without a data frame after "bus off" before the bus is opened anew


@dataclass
class Counts:
    """What a link has met since the start."""

    frames: int = 0
    errors: int = 0
    remote: int = 0
    malformed: int = 0
    bus_off: int = 0
    kernel_drops: int = 0
    queue_drops: int = 0
    opened: int = 0
    attempts_failed: int = 0

    @property
    def reopened(self) -> int:
        """How often the bus was opened after the first time."""
        return max(self.opened - 1, 0)


class Link:
    """A bus that comes and goes.

    Parameters
    ----------
    spec, filters
        Which bus, and what is wanted from it; None for everything.
    settings
        Buffers and patience.
    clock
        Monotonic time [s].
    open_bus, probe, reader_of
        How to open, look at and drain the bus.
    """

    def __init__(
        self,
        spec: BusSpec,
        filters: list[CanFilter] | None,
        settings: Reception,
        clock: Callable[[], float] = time.monotonic,
        opener: Callable[[BusSpec, list[CanFilter] | None], can.BusABC] = open_bus,
        probe: Probe | None = None,
        make_reader: Callable[[can.BusABC, int], Reader] = reader_of,
    ) -> None:
        self.label = spec.label
        self.counts = Counts()
        self.hopeless: ConfigError | None = None  # why this bus can never be opened
        self.failure: Exception | None = None  # what the thread died of
        self.problem = ""  # why it is not open, or was closed last
        self.device: Device | bool | None = None
        self._spec, self._filters, self._settings, self._clock = spec, filters, settings, clock
        self._opener, self._make_reader = opener, make_reader
        self._probe = probe_of(spec) if probe is None else probe
        # A multicast group gives everybody's frames back to everybody; a CAN controller does not.
        self._echoes: deque[tuple[int, bytes]] | None = None
        if spec.resolved()["interface"] == "udp_multicast":
            self._echoes = deque(maxlen=MOST_ECHOES)
        self._bus: can.BusABC | None = None
        self._reader: Reader | None = None
        self._inbox: deque[tuple[float, Batch]] = deque()
        self._waiting = 0  # frames in the inbox
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self._drops_before = 0  # of the sockets that were open before this one
        self._wait = SHORTEST_WAIT
        self._next_attempt = self._next_probe = -float("inf")
        self._device_then: Device | bool | None = True
        self._bus_off_at: float | None = None
        self.beat = self.last_frame = self.last_error = self.opened_at = -float("inf")  # [s] monotonic

    @property
    def is_open(self) -> bool:
        """Whether there is a bus to hear and send on."""
        return self._bus is not None

    @property
    def is_up(self) -> bool:
        """Whether the network device is up, as far as there is one."""
        return self.device.is_up if isinstance(self.device, Device) else True

    @property
    def buffer_bytes(self) -> int | None:
        """Receive buffer of the open socket."""
        return None if self._reader is None else self._reader.buffer_bytes()

    def start(self) -> None:
        """Drain in a thread from now on."""
        self._thread = threading.Thread(target=self._run, name=f"drain {self.label}", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop draining and close the bus."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=5.0)
        self._shut()

    def take(self) -> list[tuple[float, Batch]]:
        """All batches that wait, each with the monotonic time [s] at which it was drained."""
        with self._lock:
            batches = list(self._inbox)
            self._inbox.clear()
            self._waiting = 0
        return batches

    def send(self, message: can.Message) -> None:
        """Put a message on the bus; tried twice, for after the link has come up the first attempt fails.

        Raises
        ------
        OSError, can.CanError
            It did not go out.
        """
        bus = self._bus
        if bus is None:
            raise can.CanOperationError(f"{self.label} is not open")
        if self._echoes is not None:
            with self._lock:
                self._echoes.append((message.arbitration_id | EXTENDED, bytes(message.data)))
        try:
            bus.send(message)
        except (OSError, can.CanError):
            bus.send(message)

    def step(self, timeout: float = READ_TIMEOUT) -> bool:
        """Open, look, drain, whichever is due; False when there is nothing to do but wait.

        Raises
        ------
        ConfigError
            The bus can never be opened.
        """
        now = self.beat = self._clock()
        if self._bus is None and not (self._is_time(now) and self._open(now)):
            return False
        try:
            assert self._reader is not None
            self._receive(self._reader.read(timeout))
            now = self._clock()
            if now >= self._next_probe and (trouble := self._look(now)):
                self._lose(trouble, now)
                return False
            if self._is_stale(now):
                log.debug("%s: silent for long; opened anew", self.label)
                self._shut()
                return self._open(now)
        except (OSError, can.CanError) as error:
            self._lose(str(error), self._clock())
            return False
        return True

    def run_once(self) -> bool:
        """One round of the thread; False when there is nothing to do but wait."""
        try:
            return self.step()
        except ConfigError as error:
            if not self.counts.opened:
                self.hopeless = error
                self._stop.set()
            else:
                self._lose(str(error), self._clock())
            return False

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                if not self.run_once():
                    self._stop.wait(READ_TIMEOUT)
        except Exception as error:  # whatever it is: the main thread is told, and ends the process
            self.failure = error

    def _is_time(self, now: float) -> bool:
        """Whether to try and open: after a pause that grows, or at once when the device has come up."""
        if now >= self._next_attempt:
            return True
        if now < self._next_probe:
            return False
        self._next_probe = now + PROBE_PERIOD
        then, self.device = self.device, self._probe()
        if not isinstance(self.device, Device) or not self.device.is_up or (isinstance(then, Device) and then.is_up):
            return False
        self._wait = SHORTEST_WAIT
        return True

    def _open(self, now: float) -> bool:
        self.device = self._probe()
        self._next_probe = now + PROBE_PERIOD
        try:
            if not self.is_up:  # it could be opened, and would say so only at the first reading
                raise NotThereError("the interface is down")
            self._bus = self._opener(self._spec, self._filters)
            self._reader = self._make_reader(self._bus, self._settings.buffer_bytes)
            self._drops_before = self.counts.kernel_drops
        except NotThereError as error:
            self.counts.attempts_failed += 1
            self._lose(str(error), now)
            return False
        self.counts.opened += 1
        self.opened_at = now
        self._device_then = self.device
        self._bus_off_at = None
        log.log(logging.INFO if self.problem or self.counts.opened == 1 else logging.DEBUG, "%s: open", self.label)
        return True

    def _look(self, now: float) -> str:
        """Trouble with the device, if any; counts what the kernel has dropped meanwhile."""
        self._next_probe = now + PROBE_PERIOD
        assert self._reader is not None
        self.counts.kernel_drops = self._drops_before + self._reader.kernel_drops()
        device = self.device = self._probe()
        if device is None:
            return "the interface is gone"
        then = self._device_then
        if isinstance(device, Device) and isinstance(then, Device) and device.index != then.index:
            return "the interface was made anew"
        if self._bus_off_at is not None and now - self._bus_off_at > BUS_OFF_WAIT:
            return "bus off"
        self._wait = SHORTEST_WAIT
        return ""

    def _is_stale(self, now: float) -> bool:
        """Whether a bus is silent for so long that its device may be another by now, and nobody can tell."""
        patience = self._settings.reopen_s
        return self.device is True and 0 < patience < now - max(self.last_frame, self.opened_at)

    def _receive(self, batch: Batch) -> None:
        if self._echoes:
            with self._lock:
                batch = replace(batch, frames=_without(batch.frames, self._echoes))
        now, counts, count = self._clock(), self.counts, len(batch.frames)
        counts.errors += batch.errors
        counts.remote += batch.remote
        counts.malformed += batch.malformed
        counts.bus_off += batch.bus_off
        if batch.errors:
            self.last_error = now
        if count:
            self.last_frame, self._bus_off_at, self.problem = now, None, ""
        if batch.bus_off and not count:
            self._bus_off_at = now if self._bus_off_at is None else self._bus_off_at
        counts.frames += count
        if not count:
            return
        with self._lock:
            if self._waiting + count <= self._settings.queue_frames:
                self._inbox.append((now, batch))
                self._waiting += count
            else:
                counts.queue_drops += count

    def _lose(self, why: str, now: float) -> None:
        self.problem = why
        log.warning("%s: %s; next attempt in at most %g s", self.label, why, self._wait)
        self._next_attempt = now + self._wait
        self._wait = min(2 * self._wait, LONGEST_WAIT)
        self._shut()

    def _shut(self) -> None:
        bus, self._bus, self._reader = self._bus, None, None
        if bus is not None:
            try:
                bus.shutdown()
            except (OSError, can.CanError) as error:
                log.debug("%s: closing: %s", self.label, error)


def _without(frames: Frames, echoes: deque[tuple[int, bytes]]) -> Frames:
    """Frames other than ``echoes``, each of which can come back once."""
    keep = np.ones(len(frames), dtype=bool)
    for i in np.flatnonzero(np.isin(frames.ident, [ident for ident, _ in echoes])).tolist():
        echo = (int(frames.ident[i]), frames.data[i, : frames.length[i]].tobytes())
        if echo in echoes:
            echoes.remove(echo)
            keep[i] = False
    return frames[keep]

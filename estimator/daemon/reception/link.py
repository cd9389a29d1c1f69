"""One bus: opened when its device is there, drained by a thread, opened again after it was lost.

The thread only drains the bus into an `Inbox`, so no computation delays it until the kernel drops frames.
"""

import logging
import threading
from collections.abc import Callable
from dataclasses import replace

import can
from can.typechecking import CanFilter

from estimator.can_io.frames import Frames
from estimator.daemon.reception.buses import BusSpec, NotThereError, open_bus
from estimator.daemon.reception.counts import Counts
from estimator.daemon.reception.device import Device, DeviceWatch, Probe, probe_of
from estimator.daemon.reception.echoes import Echoes
from estimator.daemon.reception.inbox import Inbox
from estimator.daemon.reception.reader import Batch, Reader, reader_of
from estimator.daemon.reception.uptime import since_start
from estimator.errors import ConfigError
from estimator.settings import Reception

log = logging.getLogger(__name__)

MIN_WAIT, MAX_WAIT = 1.0, 30.0  # s between attempts to open a bus
READ_TIMEOUT = 0.2  # s
KERNEL_SHARE = 2  # the kernel doubles the size that it is asked for, for its own book-keeping (socket(7))
BUS_OFF_WAIT = 2.0  # s without a data frame after "bus off" before the bus is opened anew


class Link:
    """A bus whose device may appear and disappear.

    Parameters
    ----------
    spec, filters
        Which bus, and what is wanted from it; None for everything.
    settings
        Buffers and patience.
    clock
        Monotonic time [s].
    opener, probe, make_reader
        How to open, look at and drain the bus.
    """

    def __init__(
        self,
        spec: BusSpec,
        filters: list[CanFilter] | None,
        settings: Reception,
        clock: Callable[[], float] = since_start,
        opener: Callable[[BusSpec, list[CanFilter] | None], can.BusABC] = open_bus,
        probe: Probe | None = None,
        make_reader: Callable[[can.BusABC, int], Reader] = reader_of,
    ) -> None:
        self.label = spec.label
        self.counts = Counts()
        self.hopeless: ConfigError | None = None  # why this bus can never be opened
        self.failure: Exception | None = None  # what the thread died of
        self.problem = ""  # why it is not open, or was closed last
        self._spec, self._filters, self._settings, self._clock = spec, filters, settings, clock
        self._opener, self._make_reader = opener, make_reader
        self._watch = DeviceWatch(probe_of(spec) if probe is None else probe)
        self._echoes = Echoes() if spec.resolved()["interface"] == "udp_multicast" else None
        self._bus: can.BusABC | None = None
        self._reader: Reader | None = None
        self._inbox: Inbox[tuple[float, Batch]] = Inbox(settings.queue_frames)
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None
        self.buffer_bytes: int | None = None  # of the open socket's receive buffer
        self._buffer_told: int | None = None  # the same, as logged last
        self._drops_before = 0  # of the sockets that were open before this one
        self._wait = MIN_WAIT
        self._next_attempt = -float("inf")
        self._bus_off_at: float | None = None
        self.beat = self.last_frame = self.last_error = self.opened_at = -float("inf")  # [s] monotonic

    @property
    def is_open(self) -> bool:
        """Whether the bus is open."""
        return self._bus is not None

    @property
    def device(self) -> Device | bool | None:
        """The network device as seen last; see `DeviceWatch`."""
        return self._watch.device

    @property
    def is_up(self) -> bool:
        """Whether the network device is up, as far as there is one."""
        return self._watch.is_up

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
        return self._inbox.take()

    def send(self, message: can.Message) -> None:
        """Put a message on the bus; tried twice, for after the link has come up the first attempt fails.

        It comes back among the ``own`` frames that `take` gives: as soon as it has been on the bus where the bus
        confirms that, and at once where it does not.

        Raises
        ------
        OSError, can.CanError
            It did not go out.
        """
        bus, reader = self._bus, self._reader
        if bus is None or reader is None:
            raise can.CanOperationError(f"{self.label} is not open")
        if self._echoes is not None:
            self._echoes.expect(message)
        try:
            try:
                bus.send(message)
            except (OSError, can.CanError):
                bus.send(message)
        except ValueError as error:  # of a socket that was closed in the same instant
            raise can.CanOperationError(f"{self.label} was closed: {error}") from error
        if self._echoes is None and not reader.is_confirming():
            self._inbox.offer((self._clock(), Batch(own=Frames.from_messages([message]))), 1)

    def step(self, timeout: float = READ_TIMEOUT) -> bool:
        """Open, probe or drain, whichever is due; False when there is nothing to do but wait.

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
            if self._watch.is_due(now) and (trouble := self._look(now)):
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
        if now < self._next_attempt:
            if not self._watch.is_due(now) or not self._watch.has_come_up(now):
                return False
            self._wait = MIN_WAIT
        return True

    def _open(self, now: float) -> bool:
        self._watch.look(now)
        try:
            if not self.is_up:  # it could be opened, and would say so only at the first reading
                raise NotThereError("the interface is down")
            self._bus = self._opener(self._spec, self._filters)
            self._reader = self._make_reader(self._bus, self._settings.buffer_bytes)
            self.buffer_bytes = self._reader.buffer_bytes()
            self._drops_before = self.counts.kernel_drops
        except NotThereError as error:
            self.counts.attempts_failed += 1
            self._lose(str(error), now)
            return False
        self.counts.opened += 1
        self.opened_at = now
        self._watch.keep()
        self._bus_off_at = None
        log.log(logging.INFO if self.problem or self.counts.opened == 1 else logging.DEBUG, "%s: open", self.label)
        self._tell_buffer()
        return True

    def _tell_buffer(self) -> None:
        """Log the receive buffer that the kernel has given, once for each size."""
        got, asked = self.buffer_bytes, KERNEL_SHARE * self._settings.buffer_bytes
        if got is None or got == self._buffer_told:
            return
        self._buffer_told = got
        if got >= asked:
            log.info("%s: receive buffer of %d bytes", self.label, got)
        else:
            log.warning(
                "%s: receive buffer of %d bytes, not %d: a full bus may lose frames; set net.core.rmem_max = %d",
                *(self.label, got, asked, self._settings.buffer_bytes),
            )

    def _look(self, now: float) -> str:
        """Trouble with the device, if any; counts what the kernel has dropped meanwhile."""
        self._watch.look(now)
        assert self._reader is not None
        self.counts.kernel_drops = self._drops_before + self._reader.kernel_drops()
        if self._watch.trouble:
            return self._watch.trouble
        if self._bus_off_at is not None and now - self._bus_off_at > BUS_OFF_WAIT:
            return "bus off"
        self._wait = MIN_WAIT
        return ""

    def _is_stale(self, now: float) -> bool:
        """Whether a bus without a network device is silent for so long that it is opened again."""
        patience = self._settings.reopen_s
        return self.device is True and 0 < patience < now - max(self.last_frame, self.opened_at)

    def _receive(self, batch: Batch) -> None:
        if self._echoes is not None:
            others, own = self._echoes.split(batch.frames)
            batch = replace(batch, frames=others, own=own)
        now, count = self._clock(), len(batch.frames)
        self.counts.add(batch)
        if batch.errors:
            self.last_error = now
        if count:
            self.last_frame, self._bus_off_at, self.problem = now, None, ""
        if batch.bus_off and not count:
            self._bus_off_at = now if self._bus_off_at is None else self._bus_off_at
        if count or len(batch.own):
            self._inbox.offer((now, batch), count + len(batch.own))
            self.counts.queue_drops = self._inbox.dropped

    def _lose(self, why: str, now: float) -> None:
        self.problem = why
        log.warning("%s: %s; next attempt in at most %g s", self.label, why, self._wait)
        self._next_attempt = now + self._wait
        self._wait = min(2 * self._wait, MAX_WAIT)
        self._shut()

    def _shut(self) -> None:
        bus, self._bus, self._reader, self.buffer_bytes = self._bus, None, None, None
        if bus is not None:
            try:
                bus.shutdown()
            except (OSError, can.CanError) as error:
                log.debug("%s: closing: %s", self.label, error)

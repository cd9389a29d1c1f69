"""The daemon's loop: frames from the bus to the estimator, estimates to the transmitter, and the status.

The sampler runs in another thread, so that the loop answers requests on the bus in time.
"""

import logging
import os
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from math import inf
from pathlib import Path

from estimator import __version__
from estimator.answers.status import State, StatusAnswer
from estimator.can_io.frames import Frames
from estimator.can_io.trouble_codes import TroubleMemory
from estimator.daemon.outputs.output import Output
from estimator.daemon.reception.link import Link
from estimator.daemon.reception.message_clock import MessageClock
from estimator.daemon.reception.reader import Batch
from estimator.daemon.reception.uptime import since_start
from estimator.daemon.service import metrics, status, status_file
from estimator.daemon.service.faults import Faults
from estimator.daemon.service.sd_notify import Notifier
from estimator.daemon.service.worker import Worker
from estimator.daemon.transmitter import Transmitter
from estimator.errors import RoadloadError
from estimator.estimates import Estimate, Slope
from estimator.output_files import write
from estimator.report import summary
from estimator.streaming.listener import Listener

log = logging.getLogger(__name__)

PERIOD = 0.05  # s between turns: a request is answered within 200 ms (J1939-21)
REPORT_PERIOD = 1.0  # s
MAX_WORK = 20.0  # s for one update: beyond, the estimator counts as hung
MAX_PAUSE = 10.0  # s between two rounds of a draining thread: beyond, it counts as hung
MIN_UNWANTED_DURATION, MIN_UNWANTED_FRAMES = 60.0, 600  # s, and frames in it, of traffic with nothing wanted in it
MIN_ERRORS_DURATION = 2.0  # s without a data frame while error frames come


class Daemon:
    """Links, estimator and transmitter, turned by a loop.

    Parameters
    ----------
    source, target
        The bus to receive from, and the bus to send on where it is another.
    worker
        The estimator.
    transmitter
        None to listen only.
    own_faults
        Finds what the transmitter is to send as trouble codes.
    silence
        Time without a frame [s] after which the ignition counts as off.
    status_file, metrics_file
        Where the status goes; None for nowhere.
    save_codes
        Keeps trouble codes where they outlast the power; raises RoadloadError where that is not possible.
    clock, wall
        Monotonic and wall time [s].
    outputs
        Other programs that get the estimate, by name.
    stale_after
        Age [s] from which they do not.
    """

    def __init__(
        self,
        source: Link,
        target: Link | None,
        worker: Worker,
        transmitter: Transmitter | None,
        silence: float,
        status_file: Path | None = None,
        metrics_file: Path | None = None,
        notifier: Notifier | None = None,
        clock: Callable[[], float] = since_start,
        wall: Callable[[], float] = time.time,
        own_faults: Faults | None = None,
        save_codes: Callable[[TroubleMemory], None] | None = None,
        clocks: Mapping[str, MessageClock] | None = None,
        outputs: Mapping[str, Output] | None = None,
        stale_after: float = inf,
    ) -> None:
        self.source, self.target, self.worker, self.transmitter = source, target, worker, transmitter
        self._output = target or source
        self.listener = Listener(worker, self._broadcast)
        self.state = State.WAITING
        self.detail = ""
        self.reported: StatusAnswer | None = None  # the newest status, made every REPORT_PERIOD
        self._is_receiving = False
        self._silence, self._clock, self._wall = silence, clock, wall
        self._status_file, self._metrics_file = status_file, metrics_file
        self._faults, self._save_codes = own_faults, save_codes
        self._outputs, self._stale_after = outputs or {}, stale_after
        self._notifier = notifier or Notifier()
        self._is_ready = False
        ahead = wall() - clock()
        kept = clocks or {}
        self.clocks = {key: kept.get(key, MessageClock(ahead)) for key in map(self._clock_key, self._links())}
        self._report_due = -float("inf")
        self._last_report: tuple[float, int] | None = None
        self._opened = 0
        self._device_frames: tuple[int, float] | None = None  # received by the device at a time [s]
        self._unwanted = False
        self._started = wall()

    def start(self) -> None:
        """Start the threads."""
        for link in self._links():
            link.start()
        self.worker.start()
        for output in self._outputs.values():
            output.start()

    def close(self) -> None:
        """Send "not available", stop the threads, save."""
        now = self._clock()
        for output in self._outputs.values():
            output.stop()
        if self.transmitter is not None and self._is_receiving:
            self.transmitter.send_not_available(now, self._time(self.source).at(now))
        self._pass_on()
        for link in self._links():
            link.close()
        try:
            self._pass_on()
            self.worker.close()
        finally:
            for output in self._outputs.values():
                output.close()
            for file in (self._status_file, self._metrics_file):
                if file is not None:
                    with suppress(OSError):  # a status that stays is known by the process that has ended
                        file.unlink()

    def turn(self) -> None:
        """One turn of the loop.

        Raises
        ------
        ConfigError
            A bus can never be opened.
        RoadloadError
            A thread has died.
        """
        self._pass_on()
        now = self._clock()
        self._judge(now)
        for link in self._links():
            if link.hopeless is not None:
                raise link.hopeless
            if link.failure is not None:
                raise RoadloadError(f"{link.label}: draining failed: {link.failure!r}") from link.failure
        if self.worker.failure is not None:
            raise RoadloadError(f"the estimator failed: {self.worker.failure!r}") from self.worker.failure
        if self.transmitter is not None:
            if self._output.counts.opened != self._opened:
                if self._opened:
                    self.transmitter.restart()
                self._opened = self._output.counts.opened
            if self._output.is_open:
                self.listener.turn(self._time(self.source).at(now))
        if now >= self._report_due:
            self._report_due = now + REPORT_PERIOD
            self._observe_faults(now)
            self._report(now)

    def status(self, now: float) -> StatusAnswer:
        """The status at a monotonic time [s]."""
        t, knowledge = self._time(self.source).at(now), self.worker.knowledge
        return StatusAnswer(
            version=__version__,
            pid=os.getpid(),
            started_s=round(self._started, 3),
            written_s=round(self._wall(), 3),
            written_monotonic_s=now,
            state=self.state,
            detail=self.detail,
            frames_per_s=self._rate(now),
            clock_steps=self._time(self.source).steps,
            input=status.of_link(self.source, now),
            output=None if self.target is None else status.of_link(self.target, now),
            estimator=status.of_worker(self.worker, now),
            transmit=status.of_transmitter(self.transmitter),
            signals=status.of_signals(knowledge, t),
            missing=knowledge.missing,
            sources=dict(knowledge.sources),
            contested=dict(knowledge.contested),
            senders_replaced=knowledge.replacements,
            frames_used=knowledge.used,
            refused=dict(knowledge.refused),
            samples_rejected=dict(knowledge.rejected),
            failed_updates=knowledge.failed_updates,
            estimate=summary.conclusion(knowledge.estimate, t, knowledge.start),
            progress=knowledge.progress,
            outputs={name: output.status() for name, output in self._outputs.items()},
            road_now=status.of_road(self.listener.slope(t)),
            references=status.of_references(knowledge, t),
        )

    def is_healthy(self, now: float) -> bool:
        """Whether no draining thread and no estimator is hung: only then the watchdog is notified."""
        draining = all(now - link.beat < MAX_PAUSE for link in self._links())
        return draining and self.worker.stuck_for(now) < MAX_WORK

    def _broadcast(self, t: float, estimate: Estimate | None, slope: Slope | None) -> None:
        if self.transmitter is not None:
            self.transmitter.turn(self._clock(), t, estimate, self._is_receiving, slope)

    def _links(self) -> list[Link]:
        return [self.source, *([self.target] if self.target is not None else [])]

    def _time(self, link: Link) -> MessageClock:
        return self.clocks[self._clock_key(link)]

    def _clock_key(self, link: Link) -> str:
        return f"{'input' if link is self.source else 'output'} {link.label}"

    def _pass_on(self) -> None:
        """Hand the drained frames to estimator and transmitter."""
        for link in self._links():
            clock = self._time(link)
            for drained_at, batch in link.take():
                frames = _at(clock, batch, drained_at)
                if link is self.source and len(frames):
                    self.listener.hear(frames)
                if self.transmitter is not None and link is self._output:
                    t = self._time(self.source).at(drained_at)
                    self.transmitter.estimate, self.transmitter.slope = self.listener.fresh(t), self.listener.slope(t)
                    self.transmitter.hear(frames, batch.own, drained_at)
                elif self.transmitter is not None:
                    self.transmitter.hear_elsewhere(frames)

    def _judge(self, now: float) -> None:
        """Set ``state`` and ``detail`` of the bus."""
        before, link = self.state, self.source
        silent = now - max(link.last_frame, link.opened_at)
        erring = now - link.last_error < MIN_ERRORS_DURATION and silent > MIN_ERRORS_DURATION
        self._is_receiving = link.is_open and link.is_up and not erring and now - link.last_frame <= self._silence
        if not link.is_open:
            self.state, self.detail = State.WAITING, link.problem
        elif not link.is_up:
            self.state, self.detail = State.WAITING, f"{link.label} is down"
        elif erring:
            self.state, self.detail = State.FAULT, "error frames only: wrong bit rate, or nobody else on the bus"
        elif silent > self._silence and self._is_unwanted(now):
            self.state, self.detail = State.FAULT, "traffic, but nothing wanted in it: see roadload check"
        elif silent > self._silence:
            self.state, self.detail = State.SILENT, ""
        elif self._is_receiving and (contested := self.worker.knowledge.contested):
            reasons = [f"{path}: {reason}" for path, reason in sorted(contested.items())]
            self.state, self.detail = State.FAULT, f"contested {'; '.join(reasons)}"
        elif self._is_receiving:
            self.state, self.detail = State.RECEIVING, ""
        else:
            self.state, self.detail = State.LISTENING, ""
        if self.state != before:
            detail = f" ({self.detail})" if self.detail else ""
            level = logging.WARNING if self.state == State.FAULT else logging.INFO
            log.log(level, "%s: %s%s", self.state.value, link.label, detail)

    def _is_unwanted(self, now: float) -> bool:
        """Whether the device has received plenty of late, none of which passed the filters."""
        received = getattr(self.source.device, "received", None)
        if received is None:
            return False
        quiet_since = max(self.source.last_frame, self.source.opened_at)
        if self._device_frames is None or self._device_frames[1] < quiet_since:
            self._device_frames, self._unwanted = (received, now), False
        count, since = self._device_frames
        if now - since > MIN_UNWANTED_DURATION:
            self._device_frames, self._unwanted = (received, now), received - count > MIN_UNWANTED_FRAMES
        return self._unwanted

    def _rate(self, now: float) -> float | None:
        before, count = self._last_report, self.source.counts.frames
        if before is None or now <= before[0]:
            return None
        return round((count - before[1]) / (now - before[0]), 1)

    def _observe_faults(self, now: float) -> None:
        """Give the faults to the transmitter; without traffic nothing can be said of the inputs."""
        diagnostics = None if self.transmitter is None else self.transmitter.diagnostics
        if diagnostics is None or self._faults is None or not self._is_receiving:
            return
        lost = self.source.counts.kernel_drops + self.source.counts.queue_drops + self.worker.drops
        present = self._faults.present(self.worker.knowledge, now, lost, self.worker.save_problem)
        if not diagnostics.observe(present, now):
            return
        log.warning("active trouble codes: %s", ", ".join(map(str, diagnostics.memory.active)) or "none")
        if self._save_codes is not None:
            try:
                self._save_codes(diagnostics.memory)
            except RoadloadError as error:
                log.warning("trouble codes not saved: %s", error)

    def _show(self, now: float, written: float) -> None:
        """Leave the estimate to the outputs."""
        if not self._outputs:
            return
        t = self._time(self.source).at(now)
        report = status.published(
            self.listener.latest, self.listener.fresh(t), self.state, t, written, self._stale_after
        )
        for output in self._outputs.values():
            output.offer(report)

    def _report(self, now: float) -> None:
        found = self.reported = self.status(now)
        self._show(now, found.written_s)
        self._last_report = (now, self.source.counts.frames)
        try:
            if self._status_file is not None:
                status_file.write(self._status_file, found)
            if self._metrics_file is not None:
                write(self._metrics_file, metrics.exposition(found).encode(), 0o644)
        except RoadloadError as error:
            log.warning("status not written: %s", error)
        estimate = found.estimate
        known = "no estimate yet" if estimate is None else f"{estimate.status} {estimate.reason}".strip()
        drops = self.source.counts.kernel_drops + self.source.counts.queue_drops + self.worker.drops
        line = f"STATUS={self.state.value}; {found.frames_per_s or 0:.0f} frames/s; {drops} dropped; {known}"
        # Ready as soon as the loop turns: a bus may be away for weeks, and that is no failure to start.
        ready = [] if self._is_ready else ["READY=1"]
        self._is_ready = True
        self._notifier.send(*ready, line, *(["WATCHDOG=1"] if self.is_healthy(now) else []))


def _at(clock: MessageClock, batch: Batch, drained_at: float) -> Frames:
    frames = batch.frames
    return Frames(clock.correct(frames.t, drained_at), frames.ident, frames.length, frames.data)

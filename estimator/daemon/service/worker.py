"""The thread that estimates from the frames of the loop, and saves its state.

Only this thread uses the pipeline; others read the `Knowledge` that it makes. A slow update delays the frames that wait
here, not the reception of further ones.
"""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import inf
from typing import Any, Protocol

from estimator.answers.reference import References
from estimator.answers.status import Progress
from estimator.can_io.frames import Frames
from estimator.daemon.reception.inbox import Inbox
from estimator.daemon.reception.uptime import since_start
from estimator.daemon.service.boot_id import boot_id
from estimator.errors import RoadloadError
from estimator.estimates import Estimate
from estimator.estimation.road_now import RoadAhead
from estimator.report import summary
from estimator.report.history import History
from estimator.streaming.pipeline import Pipeline

log = logging.getLogger(__name__)

BOOT = "boot"  # in a saved state: which start of the machine it is from
SURVEY_PERIOD = 1.0  # s between refreshed `Knowledge`
IDLE_WAIT = 0.05  # s


class Store(Protocol):
    """Store of saved states; see `estimator.checkpoint.store`."""

    def save(self, state: Mapping[str, Any], key: str) -> None:
        """Keep a state."""


@dataclass(frozen=True, kw_only=True)
class Knowledge:
    """Copy of the pipeline's results at message time ``t`` [s]; counts are since the start."""

    t: float | None = None
    rows_until: float | None = None  # [s], to which speed or power was read
    load_until: float = inf  # [s], from which on the load may be another than that of the estimate
    start: float | None = None  # message time [s] of the first frame
    estimate: Estimate | None = None
    frames: int = 0
    used: int = 0
    readings: Mapping[str, int] = field(default_factory=dict)  # by role
    newest: Mapping[str, float] = field(default_factory=dict)  # message time [s] of the newest valid one, by role
    missing: tuple[str, ...] = ()  # inputs that the model needs and that never came
    refused: Mapping[str, int] = field(default_factory=dict)  # frames and values, by message, signal and reason
    rejected: Mapping[str, int] = field(default_factory=dict)  # samples, by reason
    failed_updates: int = 0  # numerically
    sources: Mapping[str, int] = field(default_factory=dict)
    contested: Mapping[str, str] = field(default_factory=dict)  # reason, by message and signal
    replacements: int = 0  # senders given up for others
    progress: Progress | None = None  # of the driving; None before the first frame
    references: References = field(default_factory=References)  # with their age at t


class Worker:
    """Feeds a pipeline from a bounded queue.

    Parameters
    ----------
    pipeline
        Already restored, where there was something to restore.
    most
        Frames that may wait; newer ones are dropped and counted.
    store, key, save_interval
        Where the state is kept, for which vehicle and configuration, and how often [s] while driving adds to it; no
        store, no state.
    clock
        Monotonic time [s].
    """

    def __init__(
        self,
        pipeline: Pipeline,
        most: int,
        store: Store | None = None,
        key: str = "",
        save_interval: float = 60.0,
        clock: Callable[[], float] = since_start,
    ) -> None:
        self.pipeline = pipeline
        self.knowledge = Knowledge(
            t=pipeline.traffic.until,
            load_until=pipeline.load_until,
            estimate=pipeline.latest,
            contested=pipeline.traffic.contested,
            replacements=pipeline.traffic.replacements,
        )
        self.road_now: RoadAhead | None = None  # as of the newest rows
        self.longest = self.last_conclusion = 0.0  # [s] that a batch with a conclusion took
        self.saves: Counter[str] = Counter()
        self.saved_at: float | None = None  # [s] monotonic
        self.save_problem = ""  # why the last attempt to save failed
        self.failure: Exception | None = None
        self._store, self._key, self._interval, self._clock = store, key, save_interval, clock
        self._history = History()
        self._inbox: Inbox[Frames] = Inbox(most)
        self._busy_since: float | None = None
        self._survey_due = -float("inf")
        self._save_due = clock() + save_interval
        self._fed = False  # since the last save
        self._kept = pipeline.estimator.progress  # by the last save
        self._thread: threading.Thread | None = None
        self._t = pipeline.traffic.until

    @property
    def latest(self) -> Estimate | None:
        """The newest estimate that is known outside the thread."""
        return self.knowledge.estimate

    @property
    def heard(self) -> float | None:
        """Message time [s] of the newest frame that `latest` knows."""
        return self.knowledge.t

    @property
    def rows_until(self) -> float | None:
        """Message time [s] to which `latest` knows speed or power; None before, and after an interruption."""
        return self.knowledge.rows_until

    @property
    def load_until(self) -> float:
        """Message time [s] from which on the load may be another than that of `latest`."""
        return self.knowledge.load_until

    @property
    def backlog(self) -> int:
        """Frames that wait."""
        return self._inbox.waiting

    @property
    def drops(self) -> int:
        """Frames that found no room."""
        return self._inbox.dropped

    @property
    def is_running(self) -> bool:
        """Whether its thread uses the pipeline, which it may after `close`, too."""
        return self._thread is not None and self._thread.is_alive()

    def stuck_for(self, now: float) -> float:
        """For how long [s] the work at hand has taken so far."""
        since = self._busy_since
        return 0.0 if since is None else now - since

    def offer(self, frames: Frames) -> None:
        """Hand over frames; what does not fit is dropped, whole batches at a time."""
        self._inbox.offer(frames, len(frames))

    def start(self) -> None:
        """Work in a thread from now on."""
        self._thread = threading.Thread(target=self._run, name="estimator", daemon=True)
        self._thread.start()

    def close(self, timeout: float = 10.0) -> None:
        """Finish what waits, as far as time allows, and save."""
        self._inbox.close()
        if self._thread is not None:
            self._thread.join(timeout)
            if self.is_running:
                log.warning("%s", "the estimator did not finish in time; what it did since the last save is lost")
                return
        if self.failure is None:  # else what there is may be broken, and is not kept
            try:
                self.turn()
            except Exception as error:  # of any kind, as in the thread
                self.failure = error
                log.error("the estimator failed; what it did since the last save is lost: %r", error)
                return
            self.save()

    def turn(self) -> None:
        """Work through all that waits; then save and survey when due."""
        waiting = self._inbox.take()
        began = self._busy_since = self._clock()
        if waiting:
            self._feed(Frames.concatenate(waiting), began)
        now = self._clock()
        if now >= self._save_due:
            self._save_due = now + self._interval
            # Writing wears flash memory: a vehicle at rest adds too little for a save.
            if self.pipeline.estimator.progress != self._kept:
                self.save()
        if now >= self._survey_due:
            self._survey_due = now + SURVEY_PERIOD
            self.knowledge = self._survey()
        self._busy_since = None

    def save(self) -> None:
        """Keep the state, if frames have come since and there is a place to keep it.

        A restored state stays as it is until the frames show whether its load is another.
        """
        if self._store is None or not self._fed or self.pipeline.traffic.is_restored:
            return
        progress = self.pipeline.estimator.progress
        try:
            self._store.save({**self.pipeline.state(), BOOT: boot_id()}, self._key)
        except (OSError, RoadloadError) as error:
            self.saves["failed"] += 1
            self.save_problem = str(error)
            log.warning("state not saved: %s", error)
            return
        self.save_problem = ""
        self._fed, self._kept = False, progress
        self.saves["saved"] += 1
        self.saved_at = self._clock()

    def _run(self) -> None:
        try:
            while self._inbox.wait(SURVEY_PERIOD):
                self.turn()
                time.sleep(IDLE_WAIT)  # so that little batches gather into larger ones
        except Exception as error:  # of any kind: the main thread reads it, and ends the process
            self.failure = error

    def _feed(self, frames: Frames, began: float) -> None:
        self._t, self._fed = float(frames.t[-1]), True
        concluded = None
        for concluded in self.pipeline.feed(frames, began):
            self._history.add(concluded, self.pipeline.traffic.start or 0.0)
            log.info("estimate: %s", summary.in_one_line(concluded))
        self.road_now = self.pipeline.road_now
        self._report_contests()
        if concluded is not None:
            self.last_conclusion = self._clock() - began
            self.longest = max(self.longest, self.last_conclusion)
            self._survey_due = began

    def _report_contests(self) -> None:
        """Log what has become, or is no longer, contested; the loop is to know at once."""
        before, contested = self.knowledge.contested, self.pipeline.traffic.contested
        for path in sorted(contested.keys() - before.keys()):
            log.warning("%s is contested: %s; no estimate until it is not", path, contested[path])
        for path in sorted(before.keys() - contested.keys()):
            log.info("%s is no longer contested", path)
        if self.pipeline.traffic.replacements != self.knowledge.replacements:
            log.warning("%s", "a sender was replaced by another: what was learnt from the first is forgotten")
            self._survey_due = -float("inf")
        if contested != before:
            self._survey_due = -float("inf")

    def _survey(self) -> Knowledge:
        pipeline = self.pipeline
        return Knowledge(
            t=self._t,
            rows_until=pipeline.traffic.rows.until,
            load_until=pipeline.load_until,
            start=pipeline.traffic.start,
            estimate=pipeline.latest,
            frames=pipeline.traffic.frames,
            used=pipeline.traffic.used,
            readings={role.value: count for role, count in pipeline.traffic.seen.items()},
            newest={role.value: t for role, t in pipeline.traffic.newest.items()},
            missing=tuple(pipeline.traffic.missing),
            refused=dict(pipeline.traffic.errors),
            rejected=dict(pipeline.estimator.rejected),
            failed_updates=pipeline.estimator.failed_updates,
            sources=pipeline.traffic.sources,
            contested=pipeline.traffic.contested,
            replacements=pipeline.traffic.replacements,
            progress=summary.progress(pipeline, self._history.points),
            references=summary.references(pipeline, pipeline.latest),
        )

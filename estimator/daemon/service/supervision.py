"""Signals: SIGTERM and SIGINT end the daemon cleanly, SIGHUP has it read its configuration again."""

import logging
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from types import FrameType

from estimator.blas_threads import one_blas_thread
from estimator.config import Config
from estimator.daemon.reception.message_clock import MessageClock
from estimator.daemon.service import folder_lock, folders
from estimator.daemon.service.assembly import Plan, assemble, rehearse
from estimator.daemon.service.loop import PERIOD, Daemon
from estimator.daemon.service.sd_notify import Notifier
from estimator.errors import RoadloadError
from estimator.streaming.pipeline import Pipeline

log = logging.getLogger(__name__)


class Signals:
    """Requests to the process by signals: to stop, or to reload its configuration."""

    def __init__(self) -> None:
        self.stop = threading.Event()
        self.reload = threading.Event()

    @contextmanager
    def caught(self) -> Iterator["Signals"]:
        """Take over SIGTERM, SIGINT and SIGHUP; the handlers of before come back at the end."""

        def on_stop(number: int, frame: FrameType | None) -> None:
            self.stop.set()

        def on_reload(number: int, frame: FrameType | None) -> None:
            self.reload.set()

        handlers = {signal.SIGTERM: on_stop, signal.SIGINT: on_stop, signal.SIGHUP: on_reload}
        before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
        try:
            yield self
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)


@one_blas_thread()
def supervise(make_plan: Callable[[], Plan], signals: Signals, notifier: Notifier | None = None) -> None:
    """Run until told to stop; on SIGHUP go on with the new configuration, or with the old one if that cannot be used.

    Raises
    ------
    InputError
        The configuration given at the start is wrong, or a bus can never be opened.
    RoadloadError
        The daemon broke down.
    """
    notifier = notifier or Notifier()
    plan = make_plan()
    pipeline: Pipeline | None = None
    clocks: Mapping[str, MessageClock] | None = None
    while True:
        with folder_lock.alone(folders.state_directory(plan.config.service)) as lock:
            daemon = assemble(plan, lock, pipeline, notifier, clocks)
            following = _serve(daemon, plan, make_plan, signals, notifier)
        if following is None:
            return
        if daemon.worker.is_running:
            raise RoadloadError("the estimator did not finish before the new configuration could be used; start again")
        # The same vehicle and settings: the pipeline is kept, to the last frame, and so is its time. What an estimator
        # that failed leaves may be broken: its state is restored.
        is_same = following.key == plan.key
        clocks = daemon.clocks if is_same else None
        is_kept = is_same and daemon.worker.failure is None
        pipeline = _under(following.config, daemon.worker.pipeline) if is_kept else None
        plan = following


def _under(settings: Config, pipeline: Pipeline) -> Pipeline | None:
    """The pipeline under ``settings`` of the same key, which may have another gate; None: restore the saved state.

    A pipeline that waits for its first frames has nothing that the saved state lacks, and lacks when that was saved.
    """
    if settings.gate == pipeline.config.gate:
        return pipeline
    if pipeline.traffic.is_restored:
        return None
    other = Pipeline(settings, is_live=True)
    other.restore(pipeline.state())
    return other


def _serve(
    daemon: Daemon, plan: Plan, make_plan: Callable[[], Plan], signals: Signals, notifier: Notifier
) -> Plan | None:
    """Turn a daemon until told to stop; returns the plan of the one that is to follow, if any."""
    following: Plan | None = None
    daemon.start()
    try:
        while following is None and not signals.stop.wait(PERIOD):
            daemon.turn()
            if signals.reload.is_set():
                signals.reload.clear()
                following = _reload(plan, make_plan, notifier)
    finally:
        if following is None:
            notifier.send("STOPPING=1")
        daemon.close()
    return following


def _reload(running: Plan, make_plan: Callable[[], Plan], notifier: Notifier) -> Plan | None:
    notifier.reloading()
    try:
        following = make_plan()
        rehearse(following, running)
    except (RoadloadError, OSError) as error:
        log.error("the new configuration cannot be used, the old one stays: %s", error)
        notifier.send("READY=1")
        return None
    log.info("%s", "configuration read again")
    return following

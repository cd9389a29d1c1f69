"""The subcommand `watch`: a log, a bus or a running daemon on one screen that lives."""

import argparse
import logging
import time
from collections import Counter
from pathlib import Path

import can.cli

from estimator import config
from estimator.answers.status import StatusAnswer
from estimator.answers.watch import WatchAnswer
from estimator.blas_threads import one_blas_thread
from estimator.commands.arguments import add_debug, add_settings, whole_number
from estimator.commands.complaints import complain
from estimator.commands.displays import Show, display
from estimator.commands.interruption import EXIT_STATUS, note_interruption
from estimator.commands.log_options import RECORDED, complain_of_channels, settings, speed_of
from estimator.commands.status_table import print_status
from estimator.commands.tables import print_run
from estimator.commands.terminal import standard_output
from estimator.daemon.service import folders, status_file
from estimator.daemon.service.assembly import listening, plan
from estimator.daemon.service.loop import PERIOD, Daemon
from estimator.errors import ConfigError, InputError
from estimator.estimates import Estimate
from estimator.report.history import History
from estimator.streaming.log_frames import LogFrames
from estimator.streaming.pipeline import Pipeline
from estimator.streaming.replay import paced_frames, run_so_far
from estimator.watch import view

SPEED = "60"  # a minute in a second
REFRESH = 0.25  # s between views of a log
POLL = 0.5  # s between looks at a status file, which is written every second
MAX_PORT = 65_535


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments."""
    add_debug(parser)
    add_settings(parser)
    text = f"{RECORDED}; without a log or a bus, the running daemon is watched"
    parser.add_argument("log", nargs="*", type=Path, metavar="LOG", help=text)
    text = f"of a log: multiple of real time (default: {SPEED}, a minute in a second)"
    parser.add_argument("--speed", default=SPEED, metavar="max|FACTOR", help=text)
    parser.add_argument("--status", type=Path, metavar="FILE", help="status file of a daemon, if in no usual place")
    text = "also as a page at this port of 127.0.0.1; 0: any that is free"
    parser.add_argument("--web", type=_port, metavar="PORT", help=text)
    can.cli.add_bus_arguments(parser, group_title="bus (only heard, never sent on), or channel of a log")


def _port(text: str) -> int:
    port = whole_number(text)
    if port > MAX_PORT:
        raise argparse.ArgumentTypeError(f"{text!r} is no port: the largest is {MAX_PORT}")
    return port


def run(options: argparse.Namespace) -> int:
    """Watch until the end of the logs or Ctrl-C, and leave what is known as a table.

    Raises
    ------
    ConfigError
        Several things to watch are named.
    """
    logging.getLogger("estimator").addHandler(logging.NullHandler())  # the screen shows what they would say
    is_bus = any(hasattr(options, name) for name in ("interface", "bitrate")) or (
        hasattr(options, "channel") and not options.log
    )
    if sum([bool(options.log), is_bus, options.status is not None]) > 1:
        raise ConfigError("watch one thing: logs, or a bus (-i, -c), or a daemon (--status)")
    if options.log:
        return _watch_logs(options)
    return _watch_bus(options) if is_bus else _watch_daemon(options)


@one_blas_thread()
def _watch_logs(options: argparse.Namespace) -> int:
    """Play logs; exit status 0 at their end, EXIT_STATUS where Ctrl-C came before."""
    options.channels = [options.channel] if hasattr(options, "channel") else []
    speed, names = speed_of(options.speed), ", ".join(path.name for path in options.log)
    playing = _Playing(options, names)
    console = standard_output()
    with display(console, playing.look("opening"), options.web) as show:
        try:
            playing.play(speed, show)
            show(playing.look("finished"))
            while options.web is not None:
                time.sleep(POLL)  # the page stays until Ctrl-C
        except KeyboardInterrupt:
            show(playing.look("interrupted" if not playing.is_finished else "finished"))
    pipeline, logs = playing.pipeline, playing.logs
    if playing.is_finished:
        pipeline.traffic.require_inputs(", ".join(map(str, options.log)))
    complain_of_channels(logs.mixed)
    result = run_so_far(pipeline, playing.updates, logs.skipped, logs.mixed)
    if not playing.is_finished:
        note_interruption(result)
    print_run(console, result)
    return 0 if playing.is_finished else EXIT_STATUS


class _Playing:
    """Logs on their way through a pipeline, and the view of it."""

    def __init__(self, options: argparse.Namespace, names: str) -> None:
        chosen = settings(options)
        self.pipeline = Pipeline(chosen)
        self.logs = LogFrames(options.log, chosen, self._note_share)
        self.updates: list[Estimate] = []
        self.is_finished = False
        self._names, self._history, self._share = names, History(), 0.0
        self._rate: float | None = None
        self._counted = (time.monotonic(), 0)  # when, and frames by then

    def _note_share(self, share: float) -> None:
        self._share = share

    def play(self, speed: float | None, show: Show) -> None:
        """Feed all frames, and show a view after each update and every REFRESH."""
        for frames in paced_frames(self.logs, speed):
            for update in self.pipeline.feed(frames):
                self._conclude(update, show)
            if time.monotonic() - self._counted[0] >= REFRESH:
                self._count()
                show(self.look("playing"))
        for update in self.pipeline.finish():
            self._conclude(update, show)
        self.is_finished = True

    def look(self, state: str) -> WatchAnswer:
        """The view of now."""
        share = None if self.is_finished else self._share
        return view.of_pipeline(self.pipeline, self._history, self._names, state, share, self._rate)

    def _conclude(self, update: Estimate, show: Show) -> None:
        self.updates.append(update)
        self._history.add(update, self.pipeline.traffic.start or 0.0)
        show(self.look("playing"))

    def _count(self) -> None:
        """Frames per second since the last count."""
        now, frames = time.monotonic(), self.pipeline.traffic.frames
        then, before = self._counted
        self._rate, self._counted = (frames - before) / (now - then), (now, frames)


@one_blas_thread()
def _watch_bus(options: argparse.Namespace) -> int:
    """Hear a bus until Ctrl-C, exit status 0; nothing is sent."""
    planned = plan(options.config, options.dbc, options)
    daemon, console, source = listening(planned), standard_output(), planned.source.label
    with display(console, view.without_news(source, "opening", ""), options.web) as show:
        daemon.start()
        try:
            _turn(daemon, source, show)
        except KeyboardInterrupt:
            pass
        finally:
            daemon.close()
    worker = daemon.worker
    if not worker.is_running:
        updates = list(worker.pipeline.finish())
        skipped = Counter({"error frame": daemon.source.counts.errors, "remote frame": daemon.source.counts.remote})
        print_run(console, run_so_far(worker.pipeline, updates, +skipped, Counter()))
    return 0


def _turn(daemon: Daemon, source: str, show: Show) -> None:
    """Turn the loop of a daemon, and show each of its reports."""
    shown: StatusAnswer | None = None
    while True:
        daemon.turn()
        if daemon.reported is not None and daemon.reported is not shown:
            shown = daemon.reported
            show(view.of_status(shown, source))
        time.sleep(PERIOD)


def _watch_daemon(options: argparse.Namespace) -> int:
    """Look at a status file until Ctrl-C; exit status 0 if a daemon was running then, else 1."""
    places = [options.status] if options.status else folders.status_places(config.load(options.config).service)
    console = standard_output()
    seen = _look(places)
    with display(console, _shown(*seen), options.web) as show:
        try:
            while True:
                time.sleep(POLL)
                seen = _look(places)
                show(_shown(*seen))
        except KeyboardInterrupt:
            pass
    _, status, why_not = seen
    if status is None:
        complain(f"no daemon is running: {why_not}")
        return 1
    print_status(console, status)
    return 0


def _look(places: list[Path]) -> tuple[Path, StatusAnswer | None, str]:
    """The file, the status in it, and the reason why there is none that is fresh."""
    path = next((candidate for candidate in places if candidate.is_file()), places[0])
    if not path.is_file():
        return path, None, f"there is no file {path}"
    try:
        status = status_file.read(path)
    except InputError as error:
        return path, None, str(error)
    reason = status_file.obstacle_to_status(status)
    return path, None if reason else status, f"{path}: {reason}" if reason else ""


def _shown(path: Path, status: StatusAnswer | None, why_not: str) -> WatchAnswer:
    if status is None:
        return view.without_news(str(path), "no daemon is running", why_not)
    return view.of_status(status, f"daemon {status.pid} on {status.input.bus}")

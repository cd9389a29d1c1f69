"""Estimates from recorded traffic, read from files or played on a virtual bus."""

import time
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any

import can
import numpy as np

from estimator.blas_threads import one_blas_thread
from estimator.can_io.frames import Frames
from estimator.can_io.log_writer import write_log
from estimator.columns import Column, Row, columns, posterior, statistics
from estimator.config import Config
from estimator.errors import RoadloadError
from estimator.estimates import Coverage, Estimate, Slope, Status
from estimator.streaming.listener import InlineWorker, Listener, broadcast_by
from estimator.streaming.log_frames import LogFrames, Progress, as_paths, no_progress
from estimator.streaming.pipeline import Pipeline

UPDATES = (
    Column("time", "time", "UTC", "of the update"),
    Column("minutes", "number", "min", "since the first frame"),
    Column("status", "text"),
    Column("reason", "text"),
    Column("samples", "count", meaning="in the window"),
    *posterior("mass_kg", "kg", "mass"),
    *posterior("A_N", "N", "rolling and friction force"),
    *posterior("C_N_s2_m2", "N s2/m2", "aerodynamic coefficient"),
    Column("A_reason", "text", meaning="why A is not estimated"),
    Column("C_reason", "text", meaning="why C is not estimated"),
    Column("rms_W", "number", "W", "residual power"),
)
MINUTE = 60.0  # s
SLICE = 0.25  # s of real time
MAX_HELD = 3.0  # s of real time
SLOPE_PERIOD = 1.0  # s between slopes that are kept
BATCH = 1000  # frames put on the virtual bus before the listener's side is drained


@dataclass(kw_only=True)
class Run:
    """Result of one log, or of consecutive logs.

    ``mixed_channels`` counts the frames by channel where several were read as one bus. ``slopes`` are those of the road
    under the vehicle that a replay broadcast, one a second.
    """

    pipeline: Pipeline
    updates: list[Estimate]
    skipped: Counter[str]
    mixed_channels: Counter[str]
    broadcast: list[can.Message] = field(default_factory=list)
    slopes: list[Slope] = field(default_factory=list)

    @property
    def start(self) -> float:
        """Time of the first frame [s]."""
        return self.pipeline.traffic.start or 0.0

    def slope_at(self, t: float) -> Slope | None:
        """First slope that was broadcast from ``t`` [s] to SLOPE_PERIOD later; None if there is none."""
        index = bisect_left(self.slopes, t, key=attrgetter("t"))
        return self.slopes[index] if index < len(self.slopes) and self.slopes[index].t <= t + SLOPE_PERIOD else None

    @property
    def final(self) -> Estimate:
        """The last estimate."""
        return self.updates[-1]

    @property
    def table(self) -> dict[str, Any]:
        """Table with a row for each update, as arrays (n,) by column, for ``pandas.DataFrame`` or ``polars.DataFrame``.

        Missing numbers are NaN. Each effect of the configuration adds columns, e.g. `headwind_mean`.
        """
        effects = [column for name in self.pipeline.effects for column in posterior(name, "", name)]
        return columns((*UPDATES, *effects), [self._row(update) for update in self.updates])

    def _row(self, update: Estimate) -> Row:
        row: dict[str, Any] = {
            "time": update.t,
            "minutes": (update.t - self.start) / MINUTE,
            "status": update.status.value,
            "reason": update.reason,
            "samples": update.admitted,
            **statistics("mass_kg", update.mass),
            **statistics("A_N", update.A),
            **statistics("C_N_s2_m2", update.C),
            "A_reason": update.status_of("A")[1],
            "C_reason": update.status_of("C")[1],
        }
        for name, magnitude in update.effects.items():
            row |= statistics(name, magnitude)
        return row if update.rms is None else {**row, "rms_W": update.rms}


class Interrupted(KeyboardInterrupt):
    """Raised by Ctrl-C before the end of the logs; ``run`` is the result so far, without the frames still waiting."""

    def __init__(self, run: Run) -> None:
        super().__init__()
        self.run = run


@one_blas_thread()
def estimate_logs(paths: str | Path | Sequence[str | Path], config: Config, progress: Progress = no_progress) -> Run:
    """Estimate from a log, or consecutive logs, without a bus; the numbers are those of `replay`.

    Raises
    ------
    LogError
        A log cannot be read.
    MissingInputsError
        The logs lack inputs of the model.
    Interrupted
        Ctrl-C was pressed.
    """
    given = as_paths(paths)
    pipeline, logs, updates = Pipeline(config), LogFrames(given, config, progress), list[Estimate]()
    try:
        for frames in logs:
            updates += pipeline.feed(frames)
        updates += pipeline.finish()
    except KeyboardInterrupt:
        raise Interrupted(run_so_far(pipeline, updates, logs.skipped, logs.mixed)) from None
    pipeline.traffic.require_inputs(_names(given))
    return Run(pipeline=pipeline, updates=updates, skipped=logs.skipped, mixed_channels=logs.mixed)


@one_blas_thread()
def replay(
    paths: Sequence[Path],
    config: Config,
    progress: Progress = no_progress,
    speed: float | None = None,
    output: Path | None = None,
) -> Run:
    """Play logs on a virtual bus to a listener that broadcasts on the same bus.

    ``speed`` is a multiple of real time, None for the fastest possible. ``output`` is the log of the broadcasts.

    Raises
    ------
    LogError
        A log cannot be read.
    MissingInputsError
        The logs lack inputs of the model.
    RoadloadError
        The virtual bus lost frames.
    Interrupted
        Ctrl-C was pressed; ``output`` is not written.
    """
    logs, heard, slopes = LogFrames(paths, config, progress), list[can.Message](), list[Slope]()
    channel = f"replay {id(heard)}"  # unique in this process
    with _virtual_bus(channel) as vehicle, _virtual_bus(channel) as node:
        worker = InlineWorker(config)
        send = broadcast_by(config.publish, node.send)

        def broadcast(t: float, estimate: Estimate | None, slope: Slope | None) -> None:
            send(t, estimate, slope)
            if slope is not None and (not slopes or not 0 <= t - slopes[-1].t < SLOPE_PERIOD):
                slopes.append(slope)

        listener = Listener(worker, broadcast, is_log=True)
        sent = received = 0
        try:
            for frames in logs:
                for first in range(0, len(frames), BATCH):
                    batch = frames[first : first + BATCH]
                    for message in paced(batch.messages(), speed):
                        vehicle.send(message)
                        sent += 1
                    received += _drain(node, listener.on_message_received)
                    _drain(vehicle, heard.append)
            listener.stop()
        except KeyboardInterrupt:
            skipped = logs.skipped + listener.skipped
            raise Interrupted(run_so_far(worker.pipeline, [*worker.updates], skipped, logs.mixed, heard)) from None
        _drain(vehicle, heard.append)
    if received != sent:
        raise RoadloadError(f"virtual bus: {sent - received} of {sent} frames were lost")
    worker.pipeline.traffic.require_inputs(_names(paths))
    if output is not None:
        write_log(Frames.from_messages(heard), output)
    return Run(
        pipeline=worker.pipeline,
        updates=list(worker.updates),
        skipped=logs.skipped + listener.skipped,
        mixed_channels=logs.mixed,
        broadcast=heard,
        slopes=slopes,
    )


def run_so_far(
    pipeline: Pipeline,
    updates: list[Estimate],
    skipped: Counter[str],
    mixed: Counter[str],
    broadcast: Sequence[can.Message] = (),
) -> Run:
    """Result before the end of the traffic; without an estimate so far, an unestimated one with that reason."""
    if not updates:
        nothing = Estimate(
            t=pipeline.traffic.until or 0.0,
            status=Status.UNESTIMATED,
            reason="interrupted before the first conclusion",
            coverage=Coverage(0, 0),
            admitted=len(pipeline.estimator.window),
        )
        updates = [nothing]
    return Run(pipeline=pipeline, updates=updates, skipped=skipped, mixed_channels=mixed, broadcast=list(broadcast))


def paced(messages: Iterable[can.Message], speed: float | None) -> Iterator[can.Message]:
    """Yield messages at ``speed`` times the rate at which they were recorded; None: without a delay."""
    if speed is None:
        yield from messages
        return
    began, first = time.monotonic(), None
    for message in messages:
        first = message.timestamp if first is None else first
        wait = (message.timestamp - first) / speed - (time.monotonic() - began)
        if wait > 0:
            time.sleep(wait)
        yield message


def paced_frames(batches: Iterable[Frames], speed: float | None) -> Iterator[Frames]:
    """Yield frames in slices of SLICE of real time, at ``speed`` times the rate at which they were recorded.

    A gap or a step in time is cut to MAX_HELD. Without a speed, the batches pass unchanged.
    """
    if speed is None:
        yield from batches
        return
    began, due, previous = time.monotonic(), 0.0, np.nan
    for frames in batches:
        steps = np.diff(frames.t, prepend=previous) / speed
        at = due + np.cumsum(np.clip(np.nan_to_num(steps), 0.0, MAX_HELD))
        cuts = np.flatnonzero(np.diff(np.floor(at / SLICE))) + 1
        for first, end in pairwise([0, *cuts.tolist(), len(frames)]):
            if end > first:
                time.sleep(max(at[first] - (time.monotonic() - began), 0.0))
                yield frames[first:end]
        if len(frames):
            due, previous = float(at[-1]), float(frames.t[-1])


def _virtual_bus(channel: str) -> can.BusABC:
    return can.Bus(interface="virtual", channel=channel, preserve_timestamps=True, ignore_config=True)


def _drain(bus: can.BusABC, take: Callable[[can.Message], object]) -> int:
    count = 0
    while (message := bus.recv(0)) is not None:
        take(message)
        count += 1
    return count


def _names(paths: Sequence[Path]) -> str:
    return ", ".join(str(path) for path in paths)

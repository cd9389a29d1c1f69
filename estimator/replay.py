"""Recorded traffic through the pipeline: put on a virtual bus as on a vehicle, or straight from the file."""

import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import can

from estimator.can_io.frames import Frames
from estimator.can_io.logs import Log, open_log
from estimator.can_io.recorder import write_log
from estimator.config import Config
from estimator.errors import RoadloadError
from estimator.estimate import Estimate
from estimator.gateway import Gateway
from estimator.pipeline import Pipeline

BATCH = 1000  # frames put on the virtual bus before the listener's side is drained
Progress = Callable[[float], None]  # told the share of the work that is done


@dataclass
class Run:
    """What a log, or several, came to."""

    pipeline: Pipeline
    updates: list[Estimate]
    skipped: Counter[str]
    start: float  # [s] time of the first frame
    broadcast: list[can.Message] = field(default_factory=list)

    @property
    def final(self) -> Estimate:
        """The last conclusion."""
        return self.updates[-1]


def read(paths: list[Path], progress: Progress, skipped: Counter[str]) -> Iterator[Frames]:
    """Batches of all logs, one log after the other; counts the frames that are no data frames.

    Raises
    ------
    LogError
        A log is missing, empty, damaged, or its time steps back.
    """
    logs: list[Log] = [open_log(path) for path in paths]
    for i, log in enumerate(logs):
        for frames in log:
            yield frames
            progress((i + log.progress) / len(logs))
        skipped.update(log.skipped)


def estimate(paths: list[Path], config: Config, progress: Progress) -> Run:
    """Estimate from logs without a bus: same code, same numbers, only faster.

    Raises
    ------
    LogError
        A log cannot be read.
    MissingInputsError
        The logs do not carry what the model needs.
    """
    pipeline, skipped, updates = Pipeline(config), Counter[str](), list[Estimate]()
    start = None
    for frames in read(paths, progress, skipped):
        start = float(frames.t[0]) if start is None else start
        updates += pipeline.feed(frames)
    updates += pipeline.finish()
    pipeline.require_inputs(_names(paths))
    return Run(pipeline, updates, skipped, start or 0.0)


def replay(
    paths: list[Path], config: Config, progress: Progress, speed: float | None = None, output: Path | None = None
) -> Run:
    """Play logs on a virtual bus to a gateway that listens there and broadcasts on it.

    ``speed`` is a multiple of real time, None for as fast as it goes. ``output`` takes what was broadcast.

    Raises
    ------
    LogError
        A log cannot be read.
    MissingInputsError
        The logs do not carry what the model needs.
    RoadloadError
        The virtual bus lost frames.
    """
    skipped, heard = Counter[str](), list[can.Message]()
    start = None
    channel = f"replay {id(heard)}"  # nobody else's in this process
    with _virtual_bus(channel) as vehicle, _virtual_bus(channel) as node:
        gateway = Gateway(config, node.send)
        sent = received = 0
        for frames in read(paths, progress, skipped):
            start = float(frames.t[0]) if start is None else start
            for first in range(0, len(frames), BATCH):
                batch = frames[first : first + BATCH]
                for message in paced(batch.messages(), speed):
                    vehicle.send(message)
                    sent += 1
                received += _drain(node, gateway.on_message_received)
                _drain(vehicle, heard.append)
        gateway.stop()
        _drain(vehicle, heard.append)
    if received != sent:
        raise RoadloadError(f"virtual bus: {sent - received} of {sent} frames were lost")
    gateway.pipeline.require_inputs(_names(paths))
    if output is not None:
        write_log(Frames.from_messages(heard), output)
    return Run(gateway.pipeline, list(gateway.updates), skipped + gateway.skipped, start or 0.0, heard)


def paced(messages: Iterable[can.Message], speed: float | None) -> Iterator[can.Message]:
    """Hold messages back so that they pass at ``speed`` times the rate at which they were recorded."""
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


def _virtual_bus(channel: str) -> can.BusABC:
    return can.Bus(interface="virtual", channel=channel, preserve_timestamps=True, ignore_config=True)


def _drain(bus: can.BusABC, take: Callable[[can.Message], object]) -> int:
    count = 0
    while (message := bus.recv(0)) is not None:
        take(message)
        count += 1
    return count


def _names(paths: list[Path]) -> str:
    return ", ".join(str(path) for path in paths)

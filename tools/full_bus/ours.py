"""``roadload run`` on the stand-in; writes its last status and the delays to its reader and to its pipeline."""

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import full_bus.small_install  # noqa: F401  # isort: skip  (before python-can)

from estimator.answers.status import StatusAnswer
from estimator.can_io.frames import Frames
from estimator.commands.main import main as roadload
from estimator.daemon.reception.reader import Batch, SocketReader
from estimator.daemon.service import status_file
from estimator.estimates import Estimate
from estimator.streaming.pipeline import Pipeline
from full_bus import loopback
from full_bus.latency import Delays


def main(port: str, folder: str, *options: str) -> None:
    """Run until SIGTERM; write counts and delays to the folder."""
    loopback.register()
    drained, taken = Delays(), Delays()
    shown: list[StatusAnswer] = []
    read, feed, write = SocketReader.read, Pipeline.feed, status_file.write

    def timed_read(self: SocketReader, timeout: float) -> Batch:
        batch = read(self, timeout)
        drained.add(time.time() - batch.frames.t)
        return batch

    def timed_feed(self: Pipeline, frames: Frames, now: float) -> Iterator[Estimate]:
        taken.add(time.time() - frames.t)
        return feed(self, frames, now)

    def noted_write(path: Path, status: StatusAnswer) -> None:
        shown[:] = [status]
        write(path, status)

    for owner, name, function in (
        (SocketReader, "read", timed_read),
        (Pipeline, "feed", timed_feed),
        (status_file, "write", noted_write),
    ):
        setattr(owner, name, function)
    roadload(["run", "-i", loopback.NAME, "-c", port, *options])
    received, estimator = shown[0].input, shown[0].estimator
    result = {
        "frames": received.frames,
        "kernel_drops": received.kernel_drops,
        "queue_drops": received.queue_drops + estimator.queue_drops,
        "conclusion_s": estimator.longest_conclusion_s,
        "reports": {name: output.sent for name, output in shown[0].outputs.items()},
        "drained": drained.summary(),
        "processed": taken.summary(),
    }
    (Path(folder) / "result.json").write_text(json.dumps(result))


if __name__ == "__main__":
    main(*sys.argv[1:])

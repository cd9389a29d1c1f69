"""A daemon under test: the test provides bus, clock and device, and runs every step of the threads itself."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import can
import numpy as np

from estimator.can_io.binding import bind, load_database
from estimator.can_io.frames import Frames
from estimator.checkpoint.store import StateStore
from estimator.config import Config
from estimator.daemon.outputs.output import Output
from estimator.daemon.reception.buses import BusSpec
from estimator.daemon.reception.device import Device
from estimator.daemon.reception.link import Link
from estimator.daemon.reception.reader import Batch
from estimator.daemon.service import faults
from estimator.daemon.service.faults import Faults
from estimator.daemon.service.loop import Daemon
from estimator.daemon.service.worker import Worker
from estimator.daemon.transmitter import Transmitter
from estimator.settings import Reception
from estimator.streaming.pipeline import Pipeline

EPOCH = 1_700_000_000.0  # s, wall time when the monotonic clock shows 0
SAVE_INTERVAL = 10.0  # s


@dataclass(kw_only=True)
class FakeBus:
    """Keeps the messages that are sent, and those that a test puts on it until they are read."""

    sent: list[can.Message] = field(default_factory=list)
    waiting: list[Batch] = field(default_factory=list)
    failures: list[Exception] = field(default_factory=list)  # raised by the next reads
    send_failures: list[Exception] = field(default_factory=list)
    drops: int = 0
    buffer: int | None = 2 * Reception().buffer_bytes  # as the kernel counts it
    closed: bool = False
    busy: bool | None = None  # our frames are not sent; None on a bus that does not confirm them
    held: list[can.Message] = field(default_factory=list)  # while the bus is busy

    def send(self, message: can.Message) -> None:
        if self.send_failures:
            raise self.send_failures.pop(0)
        self.sent.append(message)
        if self.busy is not None:
            self.held.append(message)

    def shutdown(self) -> None:
        self.closed = True

    def read(self, timeout: float) -> Batch:
        if self.failures:
            raise self.failures.pop(0)
        if self.busy is False and self.held:
            own, self.held = Frames.from_messages(self.held), []
            return Batch(own=own)
        return self.waiting.pop(0) if self.waiting else Batch()

    def is_confirming(self) -> bool:
        return self.busy is not None

    def kernel_drops(self) -> int:
        return self.drops

    def buffer_bytes(self) -> int | None:
        return self.buffer


class Bench:
    """A daemon with one bus. ``now`` [s] is its clock; ``device`` is what the probe reports."""

    def __init__(
        self,
        folder: Path | None = None,
        config: Config | None = None,
        transmit: bool = False,
        opener: Callable[[BusSpec, object], can.BusABC] | None = None,
        store: StateStore | None = None,
        outputs: Mapping[str, Output] | None = None,
    ) -> None:
        self.now = 100.0
        self.ahead = EPOCH
        self.device: Device | bool | None = True
        self.buses: list[FakeBus] = []
        self.absent = 0  # times the bus cannot be opened
        settings = config or Config()
        self.link = Link(
            BusSpec({"interface": "virtual", "channel": "bench"}),
            None,
            settings.reception,
            clock=lambda: self.now,
            opener=opener or self._open,
            probe=lambda: self.device,
            make_reader=lambda bus, size: bus,  # type: ignore[arg-type, return-value]
        )
        self.worker = Worker(
            Pipeline(settings, is_live=True),
            settings.reception.queue_frames,
            store,
            "key",
            SAVE_INTERVAL,
            clock=lambda: self.now,
        )
        self.transmitter = None
        if transmit:
            rng = np.random.default_rng(1)
            self.transmitter = Transmitter(settings.publish, settings.transmit, self.link.send, rng)
        status = None if folder is None else folder / "status.json"
        metrics = None if folder is None else folder / "metrics.prom"
        self.daemon = Daemon(
            self.link,
            None,
            self.worker,
            self.transmitter,
            settings.reception.silence_s,
            status,
            metrics,
            clock=lambda: self.now,
            wall=lambda: self.now + self.ahead,
            own_faults=Faults(bind(settings, load_database(settings.bus.dbc)), settings.publish.stale_after_s),
            outputs=outputs,
            stale_after=settings.publish.stale_after_s,
            save_codes=None if folder is None else lambda memory: faults.save(folder / "codes.json", memory),
        )

    @property
    def bus(self) -> FakeBus:
        """The bus that was opened last."""
        return self.buses[-1]

    def _open(self, spec: BusSpec, filters: object) -> can.BusABC:
        from estimator.daemon.reception.buses import NotThereError

        if self.absent:
            self.absent -= 1
            raise NotThereError("No such device")
        self.buses.append(FakeBus())
        return self.buses[-1]  # type: ignore[return-value]

    def turn(self, seconds: float = 0.0, step: float = 0.1) -> None:
        """Advance the clock, and run link, loop and estimator at each step."""
        for _ in range(max(1, round(seconds / step))):
            self.now += step if seconds else 0.0
            self.link.step(0)
            self.daemon.turn()
            self.worker.turn()

    def put(self, *messages: can.Message) -> None:
        """Put messages of other nodes on the bus, with the present time."""
        for message in messages:
            message.timestamp = self.now + self.ahead
        self.bus.waiting.append(Batch(frames=Frames.from_messages(messages)))

    def traffic(self, seconds: float, *messages: can.Message) -> None:
        """Put messages of other nodes on the bus every 0.1 s."""
        for _ in range(round(seconds / 0.1)):
            self.now += 0.1
            self.put(*(messages or (frame(0x18FEF100),)))
            self.turn()


def frame(ident: int, data: bytes = b"\xff" * 8) -> can.Message:
    """A frame with a 29-bit id."""
    return can.Message(arbitration_id=ident, data=data, is_extended_id=True)

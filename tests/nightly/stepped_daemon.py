"""The daemon without threads: traffic that sets the clock is played to link, loop and worker, a step at a time.

So a day of traffic takes only its computing time, and a run is the same each time.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable

import can

from estimator.can_io.frames import Frames
from estimator.daemon.reception.buses import BusSpec
from estimator.daemon.reception.link import Link
from estimator.daemon.reception.reader import Batch
from estimator.daemon.service.loop import Daemon
from estimator.daemon.service.worker import Worker
from estimator.settings import Reception

VIRTUAL = {"interface": "virtual", "channel": "played"}


class PlayedTraffic(ABC):
    """Clock and reader of the bus: every read returns the next piece of the traffic and advances the time.

    Parameters
    ----------
    epoch
        Wall time [s] at which the clock shows 0.
    now
        What the clock shows at the start [s].
    """

    def __init__(self, epoch: float, now: float = 0.0) -> None:
        self.now = now
        self._epoch = epoch

    @abstractmethod
    def next_piece(self) -> Frames:
        """The next frames; advances ``now``."""

    def clock(self) -> float:
        """Monotonic time [s]."""
        return self.now

    def wall(self) -> float:
        """Time of day [s]."""
        return self._epoch + self.now

    def read(self, timeout: float) -> Batch:
        """The next frames, at once."""
        return Batch(frames=self.next_piece())

    def kernel_drops(self) -> int:
        """No frames are lost."""
        return 0

    def buffer_bytes(self) -> int | None:
        """There is no buffer."""
        return None

    def is_confirming(self) -> bool:
        """What is sent is not heard."""
        return False


def _virtual_bus() -> can.BusABC:
    return can.Bus(**VIRTUAL, ignore_config=True)


def link_to(traffic: PlayedTraffic, reception: Reception, make_bus: Callable[[], can.BusABC] = _virtual_bus) -> Link:
    """A link that reads the traffic, and sends on the bus that is made."""
    return Link(
        BusSpec(VIRTUAL), None, reception, traffic.clock, lambda *_: make_bus(), lambda: True, lambda *_: traffic
    )


def turn(link: Link, daemon: Daemon, worker: Worker) -> None:
    """One turn of what are three threads in service."""
    link.step()
    daemon.turn()
    worker.turn()

"""The network device behind a bus: whether it is there, up, and still the one that was opened."""

import socket
from collections.abc import Callable
from dataclasses import dataclass

from estimator.daemon.reception.buses import INTERFACES, BusSpec

PROBE_PERIOD = 1.0  # s between looks at the device


@dataclass(frozen=True, slots=True)
class Device:
    """State of a network device: its number changes when it is made anew; ``received`` counts all its frames."""

    index: int
    is_up: bool
    received: int


Probe = Callable[[], "Device | bool | None"]


def probe_of(spec: BusSpec) -> Probe:
    """How to look at the device behind a bus: a `Device`, None while it is gone, True where it has none."""
    found = spec.resolved()
    if found["interface"] != "socketcan" or not hasattr(socket, "AF_CAN") or not INTERFACES.is_dir():
        return lambda: True
    folder = INTERFACES / str(found["channel"])

    def look() -> "Device | bool | None":
        try:
            return Device(
                int((folder / "ifindex").read_text(encoding="ascii")),
                bool(int((folder / "flags").read_text(encoding="ascii"), 16) & 1),
                int((folder / "statistics" / "rx_packets").read_text(encoding="ascii")),
            )
        except (OSError, ValueError):
            return None

    return look


class DeviceWatch:
    """Repeated probes of a device.

    ``device`` is what was seen last: a `Device`, None while it is gone, True where there is none to look at.
    """

    def __init__(self, probe: Probe) -> None:
        self.device: Device | bool | None = None
        self._probe = probe
        self._opened: Device | bool | None = True  # as it was when the bus was opened
        self._next = -float("inf")  # [s]

    @property
    def is_up(self) -> bool:
        """Whether the device is up, as far as there is one."""
        device = self.device  # another thread probes it
        return device.is_up if isinstance(device, Device) else True

    def is_due(self, now: float) -> bool:
        """Whether it is time [s] for the next look."""
        return now >= self._next

    def look(self, now: float) -> None:
        """Probe the device at the time ``now`` [s]."""
        self._next = now + PROBE_PERIOD
        self.device = self._probe()

    def has_come_up(self, now: float) -> bool:
        """Probe the device; returns whether it has come up since the last probe."""
        then = self.device
        self.look(now)
        return isinstance(self.device, Device) and self.device.is_up and not (isinstance(then, Device) and then.is_up)

    def keep(self) -> None:
        """Take the device as probed last for the one of the open bus."""
        self._opened = self.device

    @property
    def trouble(self) -> str:
        """Why the bus that was opened is of no use any more, empty if it is."""
        if self.device is None:
            return "the interface is gone"
        then = self._opened
        if isinstance(self.device, Device) and isinstance(then, Device) and self.device.index != then.index:
            return "the interface was made anew"
        return ""

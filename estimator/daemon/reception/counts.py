"""Counts of a link since the start."""

from dataclasses import dataclass

from estimator.daemon.reception.reader import Batch


@dataclass(kw_only=True)
class Counts:
    """Frames by kind and by loss, and how often the bus was opened."""

    frames: int = 0
    errors: int = 0
    remote: int = 0
    malformed: int = 0
    bus_off: int = 0
    kernel_drops: int = 0
    queue_drops: int = 0
    opened: int = 0
    attempts_failed: int = 0

    @property
    def reopened(self) -> int:
        """How often the bus was opened after the first time."""
        return max(self.opened - 1, 0)

    def add(self, batch: Batch) -> None:
        """Count what was drained at once."""
        self.frames += len(batch.frames)
        self.errors += batch.errors
        self.remote += batch.remote
        self.malformed += batch.malformed
        self.bus_off += batch.bus_off

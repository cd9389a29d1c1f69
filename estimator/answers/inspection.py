"""The answer of `inspect` and `check`."""

from msgspec import Struct

from estimator.answers.answer import Answer
from estimator.estimates import Status


class Frames(Struct, frozen=True, kw_only=True):
    """Counts of frames; ``ids`` is the number of different identifiers, ``errors`` has counts by reason.

    ``mixed_channels`` has counts by channel where several of a log were read as one bus.
    """

    read: int
    ids: int
    used: int
    reordered: int
    steps_back: int
    errors: dict[str, int]
    mixed_channels: dict[str, int] = {}


class Input(Struct, frozen=True, kw_only=True):
    """A bound signal: share of readings without a valid value, range in SI units, gaps from and to."""

    signal: str
    readings: int
    rate_Hz: float | None
    not_available: float
    minimum: float | None
    maximum: float | None
    gaps_s: tuple[tuple[float, float], ...]


class Busy(Struct, frozen=True, kw_only=True):
    """An identifier in hexadecimal, and its frames."""

    id: str
    frames: int


class InspectionAnswer(Answer, frozen=True, kw_only=True):
    """Content of a log or a bus, and whether it allows an estimate.

    ``sources`` and ``senders`` are source addresses by signal and by message, ``contested`` reasons by signal,
    ``inputs`` and ``missing`` by role; ``warnings`` of what may be wrong in the DBC.
    """

    log: str
    duration_s: float
    frames: Frames
    sources: dict[str, int]
    contested: dict[str, str]
    senders: dict[str, tuple[int, ...]]
    inputs: dict[str, Input]
    missing: dict[str, str]
    busiest: tuple[Busy, ...]
    usable: bool
    status: Status
    reason: str
    coverage: float
    warnings: tuple[str, ...] = ()

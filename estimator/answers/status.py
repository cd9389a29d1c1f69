"""The status of a running daemon: its file, and the answer of `status`."""

from enum import StrEnum
from typing import Literal

from msgspec import UNSET, Struct, UnsetType, field

from estimator.answers.answer import Answer
from estimator.answers.reference import References
from estimator.answers.run import (
    Coefficients,
    Convergence,
    Coverage,
    CoverageMap,
    Needed,
    Parameters,
    Past,
    Road,
    RoadNow,
)
from estimator.estimates import Status


class State(StrEnum):
    """State of the daemon; only a fault requires an action."""

    WAITING = "waiting for interface"
    LISTENING = "listening"  # open, and nothing received yet
    SILENT = "ignition off"
    RECEIVING = "receiving"
    FAULT = "fault"


class Link(Struct, frozen=True, kw_only=True):
    """A bus; counts since the start."""

    bus: str
    open: bool
    up: bool
    problem: str
    silent_s: float | None
    receive_buffer_bytes: int | None
    frames: int
    errors: int
    remote: int
    malformed: int
    bus_off: int
    kernel_drops: int
    queue_drops: int
    opened: int
    attempts_failed: int
    reopened: int


class Estimator(Struct, frozen=True, kw_only=True):
    """The estimator's thread: frames that wait, time of its conclusions, and the saved state."""

    backlog_frames: int
    queue_drops: int
    conclusion_s: float
    longest_conclusion_s: float
    busy_s: float
    state_saves: dict[str, int]
    state_problem: str
    state_age_s: float | None


class Transmit(Struct, frozen=True, kw_only=True):
    """Frames sent, and frames withheld by reason; the defaults where nothing is to be sent."""

    enabled: bool
    address: int | None = None
    address_lost: bool = False
    fault: str = ""
    published: int = 0
    withheld: dict[str, int] = {}
    failed: int = 0
    foreign_weights: tuple[int, ...] = ()
    colliding_groups: tuple[str, ...] = ()
    events: dict[str, int] = {}
    trouble_codes: tuple[str, ...] = ()  # active ones


class Output(Struct, frozen=True, kw_only=True):
    """A program beside the bus that gets the estimate; counts since the start, failures by kind."""

    address: str
    connected: bool
    problem: str
    connections: int
    sent: int
    failed: dict[str, int]


class Signal(Struct, frozen=True, kw_only=True):
    """Readings of a role, and the age of the newest valid one."""

    readings: int
    age_s: float | None


class Estimate(Struct, frozen=True, kw_only=True):
    """The latest conclusion, at a time since the first frame; ``samples`` in the window.

    ``doubt``: why a unit may be wrong although the estimate stands.
    """

    status: Status
    reason: str
    age_s: float
    samples: int
    parameters: Parameters
    convergence: Convergence | None
    coverage: Coverage
    t_s: float | None = None
    road: Road | None = None
    coefficients: Coefficients | None = None
    doubt: str = ""


class Progress(Struct, frozen=True, kw_only=True):
    """How far the driving has come: time since the first frame, ``samples`` in the window, cells, past conclusions."""

    t_s: float | None
    samples: int
    needed: Needed
    coverage_map: CoverageMap
    history: tuple[Past, ...]


class StatusAnswer(Answer, frozen=True, kw_only=True):
    """Buses, signals, estimate and transmission; times of day are seconds since 1970.

    ``running`` and ``why_not`` are what `roadload status` adds to the file; ``failed_updates``: numerically.
    """

    running: bool | UnsetType = UNSET
    why_not: str | UnsetType = UNSET
    version: str
    pid: int
    started_s: float
    written_s: float
    written_monotonic_s: float
    state: State
    detail: str
    frames_per_s: float | None
    clock_steps: int
    input: Link
    output: Link | None
    estimator: Estimator
    transmit: Transmit
    signals: dict[str, Signal]
    missing: tuple[str, ...]
    sources: dict[str, int]
    contested: dict[str, str]
    senders_replaced: int
    frames_used: int
    refused: dict[str, int]
    samples_rejected: dict[str, int]
    failed_updates: int
    estimate: Estimate | None
    outputs: dict[str, Output] = field(default_factory=dict)
    progress: Progress | None = None
    road_now: RoadNow | None = None
    references: References = References()


class NotRunningAnswer(Answer, frozen=True, kw_only=True):
    """Answer of `roadload status` where no daemon has left a status file."""

    running: Literal[False] = False
    why_not: str

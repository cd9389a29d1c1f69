"""The result of a diagnosis: the verdict and the quantities behind it, for tables, JSON and pages."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from estimator.answers.diagnosis import Verdict
from estimator.columns import EVIDENCE, Column, Row, columns
from estimator.components.budget import Budget
from estimator.signals import Floats

HIDDEN_GRADE = "sd of the grade"  # name of the magnitude of a grade that no signal shows
SHOWN_SLOPE = "slope"  # the same of one that signals show
LATE, EARLY = "time_lag", "speed_filter"  # effects that a lag of power behind speed is, by its sign


@dataclass(frozen=True, slots=True)
class Magnitude:
    """Size of an effect, e.g. ``wind 6.1 +- 0.4 m/s``."""

    name: str
    value: float
    sd: float
    unit: str


@dataclass(frozen=True, slots=True)
class GapClosed:
    """Share of the mean squared residual above the noise floor that an effect takes away, with its 90 % interval."""

    fraction: float
    q05: float
    q95: float


@dataclass(frozen=True, slots=True)
class Shift:
    """Change of the road-load parameters when an effect is added."""

    mass: float  # [kg]
    A: float  # [N]
    C: float  # [N s^2/m^2]


class Span(NamedTuple):
    """When an effect acts: from and to [s] of the time since the first row of a log, and which of the logs."""

    start: float
    end: float
    log: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One candidate effect, judged on the log."""

    name: str
    probability: float  # of one that is named: that it or an equivalent one acts
    log_bayes_factor: float  # against the model without it; natural logarithm
    equivalent: tuple[str, ...]  # effects that the log cannot separate from it
    magnitude: Magnitude
    gap_closed: GapClosed | None  # None where it was not worth computing
    rms_before: float  # [W], of held-out residuals
    rms_after: float  # [W]
    shift: Shift | None
    span: tuple[Span, ...] = ()  # when it acts; empty: always
    detail: str = ""  # shape found, e.g. "from 31 deg"


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """A part of an axis where the residual is not zero."""

    axis: str
    start: float
    end: float
    unit: str
    bias: float  # [W]
    share: float  # of the squared residual
    q_value: float  # false discovery rate at which it is found


@dataclass(frozen=True, slots=True)
class NotTestable:
    """An effect that this log cannot test, and the signal that is missing."""

    name: str
    needs: str


@dataclass(frozen=True, slots=True)
class Invisible:
    """An effect that could act at its usual size without evidence, and the shift of the parameters it would cause."""

    name: str
    expected_log_bayes_factor: float
    shift: Shift
    breaks: str  # the signal or manoeuvre that would show it


@dataclass(frozen=True, slots=True)
class Remainder:
    """The process with most evidence in the residual of the final model."""

    name: str
    rms: float  # [W]
    log_bayes_factor: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Described:
    """A formula for what is left without a name: ``value`` +- ``sd`` [``unit``] x ``text``, a power [W].

    ``log_bayes_factor`` counts all formulas that were tried; ``share`` of the squared residual, averaged over seconds,
    is gone on stretches left out of the fit.
    """

    text: str
    value: float
    sd: float
    unit: str
    log_bayes_factor: float
    share: float


@dataclass(frozen=True, slots=True)
class Advice:
    """The signal or manoeuvre that separates an effect from those equivalent to it on this drive."""

    name: str
    breaks: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """What would tell effect ``a``, as it was found, from ``b``, or from none where ``b`` is empty.

    Log Bayes factors: of the drive alone (``now``), and to be expected with it. ``minutes`` that it takes; 0: a signal.
    """

    a: str
    b: str
    what: str
    minutes: float
    now: float
    expected: float


@dataclass(frozen=True, slots=True)
class Isolability:
    """|Correlation| (k, k) of the traces of all candidates on this log; effects with 1 cannot be separated."""

    names: tuple[str, ...]
    correlation: Floats
    expected_log_bayes_factor: Floats  # (k,), at the usual magnitude


@dataclass(frozen=True, slots=True, kw_only=True)
class GapMap:
    """Mean residual [W] in cells of speed x acceleration (rows, columns), NaN where there is little data."""

    speed_edges: Floats  # [m/s]
    acceleration_edges: Floats  # [m/s^2]
    before: Floats
    after: Floats
    samples: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Traces:
    """Means over 2 s of the driving whose force is known, log by log; all arrays (n,).

    Their root mean squares of `measured` less a model are those that the diagnosis states.
    """

    t: Floats  # [s] since the first row of the log
    distance: Floats  # [m], of the drive
    speed: Floats  # [m/s]
    acceleration: Floats  # [m/s^2]
    measured: Floats  # [W]
    base: Floats  # [W], plain model, with what is given
    extended: Floats  # [W], with all that was found, on stretches that its fit has not seen
    road_known: Floats  # [W], the same with the slopes of the state: what a signal of the road could show
    log: Floats  # which of the logs


CANDIDATES = (
    Column("effect", "text"),
    Column("status", "text", meaning='"named", or "candidate" for one that the verdict does not rest on'),
    *EVIDENCE,
    Column("gap_closed", "number", "1", "share of the squared residual beyond noise that it explains"),
    Column("mass_shift_kg", "number", "kg", "change of the mass with it"),
    Column("A_shift_N", "number", "N", "change of A with it"),
    Column("C_shift_N_s2_m2", "number", "N s2/m2", "change of C with it"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Diagnosis:
    """The whole answer. Without a fit (log too short, standing, no power) only verdict and obstacle are meaningful."""

    verdict: Verdict
    obstacle: str = ""  # to a fit
    effects: tuple[Finding, ...] = ()  # what is named: the road, effects by their evidence, the lag
    candidates: tuple[Finding, ...] = ()  # the whole ranking against the plain model, best first
    remaining_verdict: Verdict = Verdict.CANNOT_TELL
    remaining_log_bayes_factor: float | None = None
    remainder: Remainder | None = None
    formula: Described | None = None  # of what is left without a name
    doubtful: str = ""  # the likeliest effect of a "cannot tell" that names none
    noise_floor: float | None = None  # [W]
    rms_base: float | None = None  # [W], of the plain model
    rms_final: float | None = None  # [W], with all that was found
    base: Shift | None = None  # A, C, m of the plain model
    base_deviation: Shift | None = None  # and their sd
    final: Shift | None = None  # with the effects
    deviation: Shift | None = None
    where: tuple[Place, ...] = ()
    isolability: Isolability | None = None
    not_testable: tuple[NotTestable, ...] = ()
    invisible: tuple[Invisible, ...] = ()
    advice: tuple[Advice, ...] = ()
    experiments: tuple[Experiment, ...] = ()
    p_value: float | None = None  # of the best effect's evidence among records of noise alone
    streaming_effects: tuple[str, ...] = ()  # to configure; empty: nothing to add
    budget: Budget | None = None  # of the plain model's residual, with the road as a state
    gap_map: GapMap | None = None
    traces: Traces | None = None
    logs: tuple[str, ...] = field(default=())
    doubts: tuple[str, ...] = ()  # why the logs may not be of one vehicle
    mixed_channels: Mapping[str, int] = field(default_factory=dict)  # frames by channel, where several are one bus

    @property
    def ranking(self) -> tuple[Finding, ...]:
        """All effects, those that are named as they are beside all others, the rest alone; most evidence first."""
        named = {found.name for found in self.effects}
        others = [found for found in self.candidates if found.name not in named]
        return tuple(sorted((*self.effects, *others), key=lambda found: -found.log_bayes_factor))

    @property
    def table(self) -> dict[str, Any]:
        """A row for each effect, those of the verdict first, as arrays (n,) by column.

        ``pandas.DataFrame`` and ``polars.DataFrame`` take it. Numbers that are missing are NaN.
        """
        named = {found.name for found in self.effects}
        others = [found for found in self.candidates if found.name not in named]
        rows = [_row(found, "named") for found in self.effects] + [_row(found, "candidate") for found in others]
        return columns(CANDIDATES, rows)


def _row(found: Finding, status: str) -> Row:
    row: dict[str, Any] = {
        "effect": found.name,
        "status": status,
        "probability": found.probability,
        "log_bayes_factor": found.log_bayes_factor,
        "magnitude": found.magnitude.name,
        "value": found.magnitude.value,
        "sd": found.magnitude.sd,
        "unit": found.magnitude.unit,
    }
    if found.gap_closed is not None:
        row["gap_closed"] = found.gap_closed.fraction
    if (shift := found.shift) is not None:
        row |= {"mass_shift_kg": shift.mass, "A_shift_N": shift.A, "C_shift_N_s2_m2": shift.C}
    return row

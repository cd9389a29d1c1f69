"""Define the result of a diagnosis: the verdict and its evidence, for tables, JSON and pages."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from estimator.answers.diagnosis import Verdict
from estimator.answers.reference import References
from estimator.columns import EVIDENCE, Column, Row, columns
from estimator.components.budget import Budget
from estimator.signals import Floats

HIDDEN_GRADE = "sd of the grade"  # magnitude of slopes that no signal shows
SHOWN_SLOPE = "slope"  # magnitude of slopes that signals show
LATE, EARLY = "time_lag", "speed_filter"  # effects by the sign of the lag of power behind speed


@dataclass(frozen=True, slots=True)
class Magnitude:
    """Size of an effect, e.g. ``wind 6.1 +- 0.4 m/s``."""

    name: str
    value: float
    sd: float
    unit: str


@dataclass(frozen=True, slots=True)
class GapClosed:
    """Share of an effect in the mean square of all that was found, with its 90 % interval.

    Found are effects, nameless processes and the road; it counts as far as signals show it, or, if none does, as known.
    """

    fraction: float
    q05: float
    q95: float


@dataclass(frozen=True, slots=True)
class Shift:
    """Change of the road-load parameters between two models; also their values, or their sd."""

    mass: float  # [kg]
    A: float  # [N]
    C: float  # [N s^2/m^2]


class Span(NamedTuple):
    """Interval in which an effect acts: from and to [s] since the first row of a log, and the number of the log."""

    start: float
    end: float
    log: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """Evidence and magnitude of one effect, of the road, of the lag, or of the unknown effect."""

    name: str
    probability: float  # that it acts; of a named effect, that it or its rival acts
    log_bayes_factor: float  # against the model without it; natural logarithm
    equivalent: tuple[str, ...]  # effects that these drives cannot separate from it
    magnitude: Magnitude
    gap_closed: GapClosed | None  # None for candidates, and without a part in the budget
    rms_before: float  # [W], plain model with the given effects; of all but the lag, on aligned power
    rms_after: float  # [W], with this effect and those named before, on held-out stretches; rms_before if not computed
    shift: Shift | None  # from the model of `base` to the one with all chosen effects; None for candidates
    span: tuple[Span, ...] = ()  # when it acts; empty: always
    detail: str = ""  # fitted shape, e.g. "from 31 deg"


@dataclass(frozen=True, slots=True, kw_only=True)
class Place:
    """A part of an axis where the mean residual is not zero."""

    axis: str
    start: float
    end: float
    unit: str
    bias: float  # [W]
    share: float  # of the squared residual
    q_value: float  # smallest false discovery rate at which it is listed


@dataclass(frozen=True, slots=True)
class NotTestable:
    """An effect that these drives cannot test, and the signal that is missing."""

    name: str
    needs: str


@dataclass(frozen=True, slots=True)
class Invisible:
    """An effect that these drives cannot show at its usual magnitude, and the shift of A, C, m that it would cause."""

    name: str
    expected_log_bayes_factor: float
    shift: Shift
    shown_by: str  # signal or manoeuvre that would show it


@dataclass(frozen=True, slots=True)
class Remainder:
    """The nameless processes beside the named effects: their names, rms in the residual, and log Bayes factor."""

    name: str
    rms: float  # [W]
    log_bayes_factor: float


@dataclass(frozen=True, slots=True, kw_only=True)
class ResidualFormula:
    """Formula for the residual that no named effect explains: ``value`` +- ``sd`` [``unit``] x ``text``, a power [W].

    ``log_bayes_factor`` is less the cost of all formulas that were tried. ``share``: reduction of the squared residual,
    over means of 2 s, on stretches left out of the fit.
    """

    text: str
    value: float
    sd: float
    unit: str
    log_bayes_factor: float
    share: float


@dataclass(frozen=True, slots=True)
class Advice:
    """The signal or manoeuvre that separates an effect from those that are equivalent to it on these drives."""

    name: str
    shown_by: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Experiment:
    """Experiment ``what`` that separates effect ``a``, at its fitted magnitude, from ``b`` (empty: from no effect).

    Log Bayes factors: ``now``, of the drive alone, and ``expected``, with the experiment. ``minutes``: its duration
    [min], 0 for a signal.
    """

    a: str
    b: str
    what: str
    minutes: float
    now: float
    expected: float


@dataclass(frozen=True, slots=True)
class Isolability:
    """|Correlation| (k, k) of the traces of all candidates on the longest drive; 1: they cannot be separated."""

    names: tuple[str, ...]
    correlation: Floats
    expected_log_bayes_factor: Floats  # (k,), at usual magnitude


@dataclass(frozen=True, slots=True, kw_only=True)
class GapMap:
    """Mean residual [W] in cells of speed x acceleration (rows, columns); NaN in cells with few samples."""

    speed_edges: Floats  # [m/s]
    acceleration_edges: Floats  # [m/s^2]
    plain: Floats  # plain model
    extended: Floats  # with the named effects
    samples: Floats  # means over 2 s in each cell


@dataclass(frozen=True, slots=True, kw_only=True)
class Traces:
    """Means over 2 s of strides with a known force, log by log; all arrays (n,).

    The root mean square of ``measured`` less a model is the residual that the diagnosis states.
    """

    t: Floats  # [s] since the first row of the log
    distance: Floats  # [m] since the start of the drive
    speed: Floats  # [m/s]
    acceleration: Floats  # [m/s^2]
    measured: Floats  # [W]
    base: Floats  # [W], plain model with the given effects
    extended: Floats  # [W], with all chosen effects and the road, on held-out stretches
    road_known: Floats  # [W], base with a road that the force allows, as an ideal signal might show it
    log: Floats  # number of the log


CANDIDATES = (
    Column("effect", "text"),
    Column("status", "text", meaning='"named", or "candidate" for one that the verdict does not rest on'),
    *EVIDENCE,
    Column("gap_closed", "number", "1", "share in the mean square of all that was found"),
    Column("mass_shift_kg", "number", "kg", "change of the mass with it"),
    Column("A_shift_N", "number", "N", "change of A with it"),
    Column("C_shift_N_s2_m2", "number", "N s2/m2", "change of C with it"),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Diagnosis:
    """The whole answer.

    Without a fit (log too short, standing, no power) only `verdict`, `obstacle` and `not_testable` are meaningful.
    """

    verdict: Verdict
    obstacle: str = ""  # reason why there is no fit
    given: tuple[str, ...] = ()  # effects that the configuration has in the model
    effects: tuple[Finding, ...] = ()  # named: the road, effects by their evidence, the lag
    candidates: tuple[Finding, ...] = ()  # all effects, each alone, road, lag, unknown effect; best first
    remaining_verdict: Verdict = Verdict.CANNOT_TELL
    remaining_log_bayes_factor: float | None = None
    remainder: Remainder | None = None
    formula: ResidualFormula | None = None  # of the residual that no named effect explains
    doubtful: str = ""  # the likeliest effect if the verdict is "cannot tell" and none is named
    noise_floor: float | None = None  # [W], rms of sensor noise and white force
    rms_base: float | None = None  # [W], plain model with the given effects
    rms_final: float | None = None  # [W], with all chosen effects, on held-out stretches
    base: Shift | None = None  # A, C, m of the plain model, or of the fit with the given effects
    base_deviation: Shift | None = None  # sd of base
    final: Shift | None = None  # A, C, m with all chosen effects
    deviation: Shift | None = None  # sd of final
    longest: Span | None = None  # drive of base and final, isolability, invisible and formula; None: the only one
    where: tuple[Place, ...] = ()
    isolability: Isolability | None = None
    not_testable: tuple[NotTestable, ...] = ()
    invisible: tuple[Invisible, ...] = ()
    advice: tuple[Advice, ...] = ()
    experiments: tuple[Experiment, ...] = ()
    p_value: float | None = None  # share of records of noise with as much evidence of an effect
    streaming_effects: tuple[str, ...] = ()  # effects to configure; empty: none to add
    beyond_streaming: tuple[str, ...] = ()  # effects found that cannot be configured: no signal shows when they act
    budget: Budget | None = None  # of the residual of the plain model with the given effects
    gap_map: GapMap | None = None
    traces: Traces | None = None
    logs: tuple[str, ...] = field(default=())
    references: References = field(default_factory=References)  # estimates of other control units, in the last log
    doubts: tuple[str, ...] = ()  # why the logs may not be of one vehicle
    mixed_channels: Mapping[str, int] = field(default_factory=dict)  # frames by channel, if several are read as one bus

    @property
    def ranking(self) -> tuple[Finding, ...]:
        """All findings, most probable first, and those of one probability in tenths of a per cent by their evidence."""
        named = {finding.name for finding in self.effects}
        others = [finding for finding in self.candidates if finding.name not in named]
        every = (*self.effects, *others)
        return tuple(sorted(every, key=lambda finding: (-round(finding.probability, 3), -finding.log_bayes_factor)))

    @property
    def table(self) -> dict[str, Any]:
        """One row for each finding, named ones first, as arrays (n,) by column; missing numbers are NaN.

        ``pandas.DataFrame`` and ``polars.DataFrame`` accept it.
        """
        named = {finding.name for finding in self.effects}
        others = [finding for finding in self.candidates if finding.name not in named]
        rows = [_row(finding, "named") for finding in self.effects]
        rows += [_row(finding, "candidate") for finding in others]
        return columns(CANDIDATES, rows)


def _row(finding: Finding, status: str) -> Row:
    row: dict[str, Any] = {
        "effect": finding.name,
        "status": status,
        "probability": finding.probability,
        "log_bayes_factor": finding.log_bayes_factor,
        "magnitude": finding.magnitude.name,
        "value": finding.magnitude.value,
        "sd": finding.magnitude.sd,
        "unit": finding.magnitude.unit,
    }
    if finding.gap_closed is not None:
        row["gap_closed"] = finding.gap_closed.fraction
    if (shift := finding.shift) is not None:
        row |= {"mass_shift_kg": shift.mass, "A_shift_N": shift.A, "C_shift_N_s2_m2": shift.C}
    return row

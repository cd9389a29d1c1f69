"""The answer of `diagnose`; what is not known is null."""

from enum import StrEnum

from msgspec import Struct, field

from estimator.answers.answer import Answer
from estimator.answers.reference import References


class Verdict(StrEnum):
    """The outcome of a diagnosis."""

    NO_GAP = "no gap"
    EFFECT = "effect"
    UNKNOWN = "unknown effect"
    CANNOT_TELL = "cannot tell"


class RoadLoad(Struct, frozen=True, kw_only=True):
    """Values, sd or changes of mass, rolling resistance and drag."""

    mass_kg: float | None
    A_N: float | None
    C_N_s2_m2: float | None


class Magnitude(Struct, frozen=True, kw_only=True):
    """Size of an effect, in its unit; ``slope`` is the standard deviation of slopes that signals show."""

    name: str
    value: float | None
    sd: float | None
    unit: str


class GapClosed(Struct, frozen=True, kw_only=True):
    """Share of an effect in the mean square of all that was found, with its 90 % interval.

    Found are effects, causes without a name and the road; it counts as far as signals show it, or, if none does, as
    known.
    """

    fraction: float | None
    q05: float | None
    q95: float | None


class Finding(Struct, frozen=True, kw_only=True):
    """One effect: its evidence, its size, and when it acts.

    ``probability`` that it acts; of one that is named, that it or one that is ``equivalent`` to it does. ``span_s``
    holds times from and to, since the first row of a log, and ``span_log`` its place in ``logs``, from 0; without spans
    it acts always.

    ``rms_before_kW``: residual of the model as configured, without any of the effects that are found, on power that a
    named lag is taken out of. So it is one number for all but this lag. ``rms_after_kW``: residual with this effect and
    those named before it, so the step by one effect begins at that of the one before; of a road that no signal shows,
    if the road alone were known. Candidates that are not named are in no model: theirs is ``rms_before_kW``.
    """

    name: str
    probability: float | None
    log_bayes_factor: float | None
    equivalent: tuple[str, ...]
    magnitude: Magnitude
    gap_closed: GapClosed | None
    rms_before_kW: float | None
    rms_after_kW: float | None
    parameter_shift: RoadLoad | None
    span_s: tuple[tuple[float, float], ...]
    span_log: tuple[int, ...]
    detail: str


class Formula(Struct, frozen=True, kw_only=True):
    """A power of ``value`` +- ``sd`` [``unit``] x ``text`` that follows what is left, and names nothing.

    ``text`` is a product of powers of v [m/s], a [m/s^2], F [N], engine speed n [rad/s], time t [s], distance s [m].
    ``share`` of the squared residual is gone on stretches left out of the fit.
    """

    text: str
    value: float | None
    sd: float | None
    unit: str
    log_bayes_factor: float | None
    share: float | None


class Remaining(Struct, frozen=True, kw_only=True):
    """The verdict on what the named effects leave; ``formula`` is null where none follows it."""

    verdict: Verdict
    log_bayes_factor: float | None
    formula: Formula | None = None


class Part(Struct, frozen=True, kw_only=True):
    """Share of one cause in the residual, with its 90 % interval; of a ``given`` cause, share of its error.

    ``rms_kW``: root mean square of its power. The next two are of this cause alone beside the given ones, unlike the
    residuals of `Finding`. ``reached_kW``: residual with it in the model, on stretches left out of the fit.
    ``expected_kW``: residual to be expected if it were known exactly and no effect acted that was not found.
    """

    cause: str
    share: float | None
    q05: float | None
    q95: float | None
    rms_kW: float | None
    reached_kW: float | None
    expected_kW: float | None
    given: bool = False


class Parameters(Struct, frozen=True, kw_only=True):
    """A, C and mass, and their averages over the possible hypotheses; null without a fit.

    ``base``: of the plain model, or of the fit with the effects that the configuration gives. Of several drives they
    are of that with most usable driving: in ``span_s`` of the log that ``log`` counts from 0. These are null of one.
    """

    base: RoadLoad | None
    base_sd: RoadLoad | None
    final: RoadLoad | None
    sd: RoadLoad | None
    log: int | None = None
    span_s: tuple[float, float] | None = None


class Place(Struct, frozen=True, kw_only=True):
    """A part of an axis where the residual is not zero; ``q_value`` is its false discovery rate."""

    axis: str
    start: float | None = field(name="from")
    end: float | None = field(name="to")
    unit: str
    bias_kW: float | None
    share: float | None
    q_value: float | None


class Pair(Struct, frozen=True, kw_only=True):
    """Two effects.

    ``distance`` is the sine of the angle between their traces: 0 if nothing separates them, 1 if they have nothing in
    common.
    """

    a: str
    b: str
    distance: float | None
    correlation: float | None


class Visibility(Struct, frozen=True, kw_only=True):
    """Evidence expected of an effect of its usual size."""

    name: str
    expected_log_bayes_factor: float | None


class Isolability(Struct, frozen=True, kw_only=True):
    """Which effects this drive separates, and which it shows."""

    pairs: tuple[Pair, ...] = ()
    visibility: tuple[Visibility, ...] = ()


class NotTestable(Struct, frozen=True, kw_only=True):
    """An effect that this log cannot show, and the signal that would."""

    name: str
    needs: str


class Invisible(Struct, frozen=True, kw_only=True):
    """An effect that could act unseen at its usual size, its bias of the parameters, and the signal that shows it."""

    name: str
    expected_log_bayes_factor: float | None
    parameter_shift: RoadLoad | None
    breaks: str


class Experiment(Struct, frozen=True, kw_only=True):
    """Experiment that separates effect ``a``, at its fitted magnitude, from ``b``, or from no effect if ``b`` is empty.

    Log Bayes factors: of the drive alone (``now``), and to be expected with it. ``minutes`` that it takes; 0: a signal.
    """

    a: str
    b: str
    what: str
    minutes: float
    now: float | None
    expected: float | None


class DiagnosisAnswer(Answer, frozen=True, kw_only=True):
    """Verdict and evidence; ``effects`` are those that are named, ``candidates`` all of them.

    ``candidates`` have their evidence and size alone, and their probability among all hypotheses.
    ``given``: effects that the configuration has in the model.
    ``p_value``: share of records of noise alone in which an effect has as much evidence; null unless asked for.
    ``doubts``: why the logs may not be of one vehicle.
    """

    verdict: Verdict
    reason: str
    configuration: str
    effects: tuple[Finding, ...]
    candidates: tuple[Finding, ...]
    remaining: Remaining
    noise_floor_kW: float | None
    rms_base_kW: float | None
    rms_final_kW: float | None
    budget: tuple[Part, ...]
    parameters: Parameters
    where: tuple[Place, ...]
    isolability: Isolability
    not_testable: tuple[NotTestable, ...]
    invisible: tuple[Invisible, ...]
    advice: tuple[str, ...]
    experiments: tuple[Experiment, ...] = ()
    p_value: float | None = None
    logs: tuple[str, ...]
    doubts: tuple[str, ...] = ()
    references: References = References()
    given: tuple[str, ...] = ()

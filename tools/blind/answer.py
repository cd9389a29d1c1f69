"""The answer of the diagnosis for one log, and its comparison with the truth."""

import msgspec
import numpy as np
from numpy.typing import NDArray

from blind.truth import Truth
from estimator.answers.diagnosis import DiagnosisAnswer, Finding, GapClosed, Magnitude
from estimator.components.budget import MIN_SYSTEMATIC, NOISE, ROAD, WHITE

Spans = tuple[tuple[float, float], ...]  # from, to [s]

CREDIBLE = 0.9
CLASSES = (  # effects that one drive cannot tell apart, as printed beside the catalogue
    frozenset({"torque_gain", "speed_scale"}),
    frozenset({"slip", "load_loss"}),
    frozenset({"time_lag", "speed_filter"}),
    frozenset({"grade", "grade_measured", "grade_unmeasured"}),
)
NONE, UNKNOWN = "none", "unknown"  # candidates outside the catalogue


class Run(msgspec.Struct, frozen=True):
    """One diagnosis: the answer or the reason why there is none, and its cost."""

    drive: str
    seconds: float
    processor_seconds: float
    peak_MB: float
    answer: DiagnosisAnswer | None
    error: str = ""

    @property
    def verdict(self) -> str:
        """The verdict; ``error`` for a failed run."""
        return "error" if self.answer is None else self.answer.verdict

    @property
    def named(self) -> tuple[Finding, ...]:
        """The effects named; none unless the verdict is "effect"."""
        return self.answer.effects if self.answer is not None and self.answer.verdict == "effect" else ()

    @property
    def is_silent(self) -> bool:
        """Whether no gap was claimed."""
        return self.verdict in ("no gap", "cannot tell")


def bare(name: str, probability: float | None = None) -> Finding:
    """A finding with a name and a probability only."""
    return Finding(
        name=name,
        probability=probability,
        log_bayes_factor=None,
        equivalent=(),
        magnitude=Magnitude(name="", value=None, sd=None, unit=""),
        gap_closed=None,
        rms_before_kW=None,
        rms_after_kW=None,
        parameter_shift=None,
        span_s=(),
        span_log=(),
        detail="",
    )


def means(finding: Finding, name: str) -> bool:
    """Whether it is ``name`` or lists it as equivalent."""
    return name == finding.name or name in finding.equivalent or any({name, finding.name} <= one for one in CLASSES)


def closed_if_known(run: Run, finding: Finding) -> GapClosed | None:
    """Share of the gap that is closed where the cause of a finding is known exactly, as the oracle knows it.

    ``gap_closed`` of a grade is what the signals on the bus close. So it is the road's share of what is no noise here.
    """
    parts = {} if run.answer is None else {part.cause: part for part in run.answer.budget}
    if finding.name != "grade" or ROAD not in parts:
        return finding.gap_closed
    road, noise = parts[ROAD], sum(parts[cause].share or 0.0 for cause in (NOISE, WHITE) if cause in parts)
    fraction, q05, q95 = (
        None if share is None else min(share / max(1.0 - noise, MIN_SYSTEMATIC), 1.0)
        for share in (road.share, road.q05, road.q95)
    )
    return GapClosed(fraction=fraction, q05=q05, q95=q95)


def holds(closed: GapClosed, share: float) -> bool:
    """Whether the interval covers a share; false if there is no interval."""
    return closed.q05 is not None and closed.q95 is not None and closed.q05 <= share <= closed.q95


def first_is_right(truth: Truth, run: Run) -> bool:
    """Whether the effect named first is one of the drive's effects or equivalent to one."""
    return bool(run.named) and any(means(run.named[0], effect.name) for effect in truth.effects)


def is_alone(run: Run) -> bool:
    """Whether what is named first stands for no second effect, but for those that no drive can tell from it."""
    first = run.named[0] if run.named else None
    return first is not None and all(means(bare(first.name), other) for other in first.equivalent)


def found(truth: Truth, run: Run) -> list[bool]:
    """Which of the drive's effects are among those named."""
    return [any(means(finding, effect.name) for finding in run.named) for effect in truth.effects]


def invented(truth: Truth, run: Run) -> list[str]:
    """Named effects that are neither among the drive's effects nor physics caused by them."""
    real = [*(effect.name for effect in truth.effects), *truth.companions]
    return [f.name for f in run.named if not any(means(f, name) for name in real)]


def credible_set(run: Run) -> tuple[Finding, ...] | None:
    """The fewest candidates that hold CREDIBLE of the probability; None if the answer ranks nothing.

    The probability missing to 1 belongs to "none", unless "none" is in the ranking.
    """
    ranked = () if run.answer is None else run.answer.candidates
    if not ranked:
        return None
    listed = [f for f in ranked if f.probability is not None]
    rest = 1.0 - sum(f.probability or 0.0 for f in listed)
    if rest > 1e-6 and all(f.name != NONE for f in listed):
        listed.append(bare(NONE, rest))
    chosen: list[Finding] = []
    held = 0.0
    for finding in sorted(listed, key=lambda f: -(f.probability or 0.0)):
        if held >= CREDIBLE:
            break
        chosen.append(finding)
        held += finding.probability or 0.0
    return tuple(chosen)


def overlap(a: Spans, b: Spans, where: Spans) -> float:
    """Intersection over union of two unions of intervals, both cut to a third; 0 if both are empty there."""
    edges = np.unique(np.concatenate([np.ravel(x) for x in (a, b, where)]))
    middle, length = 0.5 * (edges[1:] + edges[:-1]), np.diff(edges)
    in_a, in_b, counts = (_inside(middle, spans) for spans in (a, b, where))
    union = float(length[(in_a | in_b) & counts].sum())
    return float(length[in_a & in_b & counts].sum()) / union if union > 0 else 0.0


def _inside(t: NDArray[np.float64], spans: Spans) -> NDArray[np.bool_]:
    found = np.zeros(len(t), dtype=bool)
    for start, end in spans:
        found |= (t >= start) & (t < end)
    return found

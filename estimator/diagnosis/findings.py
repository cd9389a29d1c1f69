"""Findings of a conclusion, as they are reported: of each effect, the road and the lag."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.answers.diagnosis import Verdict
from estimator.components.budget import ROAD, UNKNOWN, WHITE, Part
from estimator.components.drive_state import DriveState
from estimator.components.explained import Choice, Ranked
from estimator.components.processes import SWITCHES
from estimator.diagnosis.conclusion import Conclusion
from estimator.diagnosis.facts import MIN_RIVAL
from estimator.diagnosis.result import (
    HIDDEN_GRADE,
    SHOWN_SLOPE,
    Finding,
    GapClosed,
    Magnitude,
    Remainder,
    Span,
)
from estimator.estimation.form_doubt import EFFECT_DOUBT
from estimator.model.effects import Effect
from estimator.model.spans import Spans
from estimator.signals import Quantity

SLOPE_LENGTH = 300.0  # m, beyond which slopes of a road are independent
SHOWN_IN_PART, SHOWN = 0.1, 0.9  # share of the reduction by a known road that its signals give


@dataclass(frozen=True)
class Findings:
    """The findings of a ``conclusion``."""

    conclusion: Conclusion

    def named(self) -> tuple[Finding, ...]:
        """The road, the effects that are named, and the lag."""
        late = self.conclusion.lag
        road = [self._road()] if self.conclusion.is_road_found else []
        return (*road, *map(self._finding, self.conclusion.named), *(() if late is None else (late,)))

    def candidates(self, named: Sequence[Finding]) -> tuple[Finding, ...]:
        """All effects, each alone, with their probabilities in the table of models; road, lag and unknown effect.

        Those with most evidence are first.
        """
        ranking = self.conclusion.explained.ranking
        others = [finding for finding in named if finding.name not in {one.name for one in ranking}]
        beside = [self._candidate(one, self.conclusion.explained.probability[one.name], ranking) for one in ranking]
        return tuple(sorted((*others, *beside, self._left()), key=lambda f: -f.log_bayes_factor))

    def remainder(self) -> Remainder:
        """The nameless processes beside the named effects, and their evidence."""
        left = self._left()
        return Remainder(left.detail, left.magnitude.value, self.conclusion.left_over)

    def _road(self) -> Finding:
        """Finding of a sloping road; it names the signals that show it, if there are any."""
        found, readings = self._hills(), self.conclusion.longest.fit.scales.readings
        if not readings:
            return found
        part, base = self.conclusion.budget.part(ROAD), self.conclusion.budget.base
        reached = base if part is None or part.reached is None else part.reached
        shown = (base**2 - reached**2) / max(base**2 - found.rms_after**2, 1e-9)
        if shown < SHOWN_IN_PART:
            return found
        how = "shown by" if shown > SHOWN else "shown in part by"
        signals = ", ".join(name.replace("_", " ") for name in readings)
        return replace(
            found,
            magnitude=replace(found.magnitude, name=SHOWN_SLOPE),
            gap_closed=None if part is None else GapClosed(*(min(shown, 1.0) * share for share in part.closed)),
            rms_after=reached,
            shift=self.conclusion.shift,
            detail=f"varies with place; {how} {signals}",
        )

    def _hills(self) -> Finding:
        """Finding of a road that no signal shows, with the share of the gap that an ideal signal would close."""
        budget = self.conclusion.budget
        slope_sd, sd = _slopes(self.conclusion.explained.drives)
        part = budget.part(ROAD)
        return Finding(
            name="grade",
            probability=1.0,
            log_bayes_factor=self.conclusion.explanation.slopes or 0.0,
            equivalent=(),
            magnitude=Magnitude(HIDDEN_GRADE, slope_sd, sd, "1"),
            gap_closed=_closed(part),
            rms_before=budget.base,
            rms_after=budget.base if part is None else part.expected,
            shift=self.conclusion.shift,
            detail="varies with place; no signal on the bus shows it",
        )

    def _finding(self, choice: Choice) -> Finding:
        drives, budget = self.conclusion.explained.drives, self.conclusion.budget
        drive = drives[choice.drive]
        place = next(i for i, term in enumerate(drive.chosen) if term.name == choice.name)
        joint = drive.joint
        posterior, at = joint.posterior(range(len(drive.chosen))), joint.places[place][0]
        effect_term = drive.chosen[place].effect_term
        assert effect_term is not None
        part, effect, value = budget.part(choice.name), choice.effect, float(posterior.mean[at])
        sd = float(np.hypot(np.sqrt(posterior.covariance[at, at]), EFFECT_DOUBT * value))
        rivals, probability = self._rivals(choice)
        spans = [
            span
            for number, each in enumerate(drives)
            for term in each.chosen
            if term.name == choice.name
            for span in self._clock(number, term.spans or ())
        ]
        close = {*rivals, Verdict.UNKNOWN.value} if self.conclusion.is_outdone else rivals
        return Finding(
            name=choice.name,
            probability=probability,
            log_bayes_factor=choice.log_bayes_factor,
            equivalent=tuple(sorted(close | set(effect.equivalent))),
            magnitude=_magnitude(effect, value, sd),
            gap_closed=_closed(part),
            rms_before=budget.base,
            rms_after=budget.base if part is None or part.reached is None else part.reached,
            shift=self.conclusion.shift,
            span=tuple(spans),
            detail=_detail(effect_term.shape, effect),
        )

    def _rivals(self, choice: Choice) -> tuple[set[str], float]:
        """Effects that may act in place of a choice, and the probability that the choice, or it or its rival, acts."""
        least = self.conclusion.thresholds.min_probability
        if choice.probability >= least:
            return set(), choice.probability
        if choice.either >= least:
            return {choice.rival}, choice.either
        likely = {name for name, p in self.conclusion.explained.probability.items() if p > MIN_RIVAL}
        return likely - {other.name for other in self.conclusion.explained.choices}, choice.probability

    def _candidate(self, one: Ranked, probability: float, ranking: Sequence[Ranked]) -> Finding:
        which, form = one.best
        effect_term, effect, base = form.term.effect_term, one.effect, self.conclusion.budget.base
        return Finding(
            name=one.name,
            probability=probability,
            log_bayes_factor=one.gain,
            equivalent=tuple(sorted(self._alike(one, ranking))),
            magnitude=_magnitude(effect, form.value, form.sd),
            gap_closed=None,
            rms_before=base,
            rms_after=base,
            shift=None,
            span=() if effect_term is None else self._clock(which, effect_term.spans or ()),
            detail="" if effect_term is None else _detail(effect_term.shape, effect),
        )

    def _alike(self, one: Ranked, ranking: Sequence[Ranked]) -> set[str]:
        """Names of effects that a drive cannot separate from ``one``, or that the catalogue declares equivalent.

        They have evidence of their own and a trace with nearly the same course.
        """
        limits, (drive, form) = self.conclusion.thresholds, one.best
        others = [other for other in ranking if other is not one and other.gain > limits.min_log_bf_alike]
        others = [other for other in others if other.best[0] == drive]
        near = [o.name for o in others if _correlation(o.best[1].trace, form.trace) > limits.min_class_correlation]
        return {*near, *one.effect.equivalent}

    def _left(self) -> Finding:
        """Finding of the unknown effect: the nameless processes beside the chosen effects."""
        budget, nameless = self.conclusion.budget, self.conclusion.nameless
        parts = [part for part in budget.parts if part.cause.startswith(UNKNOWN) and part.cause != WHITE]
        rms = float(np.sqrt(sum(part.rms**2 for part in parts))) if parts else float("nan")
        unnamed = nameless.processes
        names = [part.cause.removeprefix(UNKNOWN) for part in parts] or [next(iter(unnamed.values())).name]
        return Finding(
            name=Verdict.UNKNOWN.value,
            probability=nameless.probability,
            log_bayes_factor=self.conclusion.left_over,
            equivalent=(),
            magnitude=Magnitude("rms", rms, float("nan"), "W"),
            gap_closed=None,
            rms_before=budget.reached,
            rms_after=budget.reached,
            shift=None,
            span=tuple(s for n, own in unnamed.items() for s in self._clock(n, own.spans or ())) if parts else (),
            detail=", ".join(self._sized(name) for name in names),
        )

    def _sized(self, name: str) -> str:
        """Name of a nameless process, with its size if it is a power or force that switches."""
        found = [(n, process) for n, process in self.conclusion.nameless.processes.items() if process.name == name]
        if name not in SWITCHES or not found:
            return name
        number, process = found[0]
        drive = self.conclusion.explained.drives[number]
        size = drive.joint_with((process,)).posterior(range(len(drive.chosen) + 1)).mean[-1]
        return f"{name} ({size:.0f} {SWITCHES[name]})"

    def _clock(self, which: int, spans: Spans) -> tuple[Span, ...]:
        """``spans`` [s] of drive ``which``, in time since the first row of its log."""
        drive = self.conclusion.cases[which].drive
        return tuple(Span(a - drive.log_start, b - drive.log_start, drive.log) for a, b in spans)


def _slopes(drives: Sequence[DriveState]) -> tuple[float, float]:
    """Standard deviation [1] of the slope along the roads of all drives, and the sd of this value."""
    share = np.array([len(drive.fit.strides) for drive in drives]) / sum(len(drive.fit.strides) for drive in drives)
    own = np.array([drive.slope_sd for drive in drives])
    independent = np.array([max(_length(drive) / SLOPE_LENGTH, 1.0) for drive in drives])
    doubt = np.array([drive.fit.slope_doubt for drive in drives]) / np.sqrt(independent)
    value = float(np.sqrt(share @ own**2))
    by_noise = float(np.linalg.norm(share * own * doubt)) / max(value, 1e-12)
    return value, float(np.hypot(by_noise, EFFECT_DOUBT * value))


def _length(drive: DriveState) -> float:
    """Length of the road driven [m], without gaps."""
    return float((drive.strides.s1 - drive.strides.s0).sum())


def _closed(part: Part | None) -> GapClosed | None:
    """Share of the gap beyond noise that the cause of a part takes, with its 90 % interval; None without a part."""
    return None if part is None else GapClosed(*part.closed)


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    """|Correlation| of two series (n,); 0 if one of them is constant."""
    if not (np.ptp(one) and np.ptp(other)):
        return 0.0
    return abs(float(np.corrcoef(one, other)[0, 1]))


def _magnitude(effect: Effect, value: float, sd: float) -> Magnitude:
    """Magnitude in the effect's unit, from the amplitude of its column and the sd of that."""
    if effect.magnitude_from_coefficient is None:
        return Magnitude(effect.symbol, value, sd, effect.unit)
    low, high = effect.magnitude_from_coefficient(value - sd), effect.magnitude_from_coefficient(value + sd)
    return Magnitude(effect.symbol, effect.magnitude_from_coefficient(value), abs(high - low) / 2, effect.unit)


def _detail(shape: object, effect: Effect) -> str:
    """The fitted shape in words; empty if there is none."""
    if isinstance(shape, Quantity):
        return shape.value
    return effect.describe(shape) if shape is not None and effect.describe is not None else ""

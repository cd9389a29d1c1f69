"""What is concluded from an explanation: the verdict, the findings and their shares of the gap, and what could hide."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from estimator.answers.diagnosis import Verdict
from estimator.components.budget import ROAD, UNKNOWN, WHITE, Budget, Part, budget
from estimator.components.component import Component, Frame, of_effect
from estimator.components.drive_state import DriveState
from estimator.components.explained import Choice, Explained, Nameless, Ranked
from estimator.components.processes import LOW_PASS, SWITCHES
from estimator.diagnosis.explanation import Explanation
from estimator.diagnosis.facts import MIN_RIVAL
from estimator.diagnosis.isolability import evidence_of, is_lasting
from estimator.diagnosis.lag import effect_of, evidence_of_lag, lag_finding, low_pass_gain
from estimator.diagnosis.model import Drive
from estimator.diagnosis.result import (
    HIDDEN_GRADE,
    SHOWN_SLOPE,
    Finding,
    GapClosed,
    Invisible,
    Magnitude,
    Remainder,
    Shift,
    Span,
)
from estimator.diagnosis.thresholds import Thresholds
from estimator.estimation.form_doubt import EFFECT_DOUBT
from estimator.estimation.road_fit import theta_jacobian
from estimator.estimation.road_likelihood import ROAD_LOAD
from estimator.estimation.shapes import averaged
from estimator.model.design_matrix import Spans
from estimator.model.effects import Effect
from estimator.signals import Quantity

MIN_LOG_BF_POSSIBLE = -3.0  # log Bayes factor from which an effect that was not chosen is part of the budget
FORCE_BY_PLACE = "force over distance"  # what slopes are that no road has
SLOPE_LENGTH = 300.0  # m, after which a road has another slope
SHOWN_IN_PART, SHOWN = 0.1, 0.9  # of what a known road would take from the square of the residual, by its signals
MAX_FORM_SHARE = 0.05  # of the evidence of a lag: errors of its form give as much to effects computed from power


@dataclass(frozen=True, kw_only=True)
class Conclusion:
    """An explanation of drives, their ``plain`` models, and the budget of the gap."""

    explanation: Explanation
    budget: Budget
    plain: tuple[Drive, ...]
    thresholds: Thresholds

    @cached_property
    def with_choices(self) -> tuple[Drive, ...]:
        """The drives with the effects that were chosen in their plain models."""
        return tuple(map(_with_choices, self.plain, self.explained.drives))

    @property
    def explained(self) -> Explained:
        """What acts on the drives."""
        return self.explanation.explained

    @property
    def longest(self) -> DriveState:
        """The drive with most strides, which figures of a single drive are taken from."""
        return self.explanation.longest

    @property
    def sure(self) -> tuple[Choice, ...]:
        """The effects that are probable enough to be named, each alone or as one of two."""
        return tuple(c for c in self.explained.choices if c.either >= self.thresholds.min_probability)

    @property
    def left_over(self) -> float:
        """Log Bayes factor of what has no name: a process beside the choices, or a force that varies with place."""
        return max(self.nameless.log_bayes_factor, self.by_place)

    @property
    def nameless(self) -> Nameless:
        """What has no name; a low-pass of the speed has that of the lag, where this is named."""
        return self.explained.nameless if self.lag is None else self.explained.beyond_low_pass

    @property
    def by_place(self) -> float:
        """Log Bayes factor of a force that varies with place and is no road."""
        is_force = self.explanation.is_sloping and not self.explanation.is_hilly
        return (self.explanation.slopes or 0.0) if is_force else 0.0

    @property
    def slope_sd(self) -> float:
        """Standard deviation of the road's slope [1]."""
        return self.longest.slope_sd

    @cached_property
    def road_load(self) -> tuple[Shift, Shift]:
        """A, C, m with the road as a state, averaged over sets of effects and over shapes, and their sd."""
        pairs = zip(self.explained.drives, self.explained.others, strict=True)
        others = next(others for drive, others in pairs if drive is self.longest)
        fit = averaged(self.longest.strides, self.longest.fit).mixed(others.shift, others.covariance)
        A, C, m = fit.theta[:ROAD_LOAD].tolist()
        dA, dC, dm = np.sqrt(np.diag(fit.theta_covariance()))[:ROAD_LOAD].tolist()
        return Shift(mass=m, A=A, C=C), Shift(mass=dm, A=dA, C=dC)

    @property
    def is_road_given(self) -> bool:
        """Whether the road is part of the model from the start."""
        return any(term.effect.is_gravity for drive in self.plain for term in drive.model.terms)

    @property
    def _shift(self) -> Shift:
        """Shift of the parameters from the plain model to the one with the road and all chosen effects."""
        model = max((drive.model for drive in self.plain), key=lambda model: len(model.samples))
        A, C, m = model.road_load.tolist()
        final, _ = self.road_load
        return Shift(mass=final.mass - m, A=final.A - A, C=final.C - C)

    def verdict(self) -> Verdict:
        """Read from the table of models.

        Effects are named unless processes without them explain more than they do.
        """
        limits, hidden = self.thresholds, self.explanation.is_hilly and not self.is_road_given
        if hidden or self.lag is not None or (self.sure and not self.is_outdone):
            return Verdict.EFFECT
        if self.left_over > limits.min_log_bf_unknown:
            return Verdict.UNKNOWN
        return Verdict.NO_GAP if self.explained.none >= limits.min_probability_no_gap else Verdict.CANNOT_TELL

    @property
    def is_outdone(self) -> bool:
        """Whether what has no name acts too, and explains more without the effects than they do without it.

        What a low-pass explains beside them is the lag's, where that is named.
        """
        likely = self.nameless.probability > self.thresholds.min_probability_no_gap
        by_processes = self.explained.by_processes if likely else 0.0
        bent = 0.0 if self.lag is None else low_pass_gain(self.explanation)
        return self.explained.by_effects + bent < max(by_processes, self.by_place)

    def remaining(self) -> Verdict:
        """Whether something without a name is left beside what was named, more than errors of the form of a lag."""
        form = 0.0 if self.lag is None else MAX_FORM_SHARE * self.lag.log_bayes_factor
        least = max(self.thresholds.min_log_bf_left, form)
        return Verdict.UNKNOWN if self.left_over > least else Verdict.NO_GAP

    def remainder(self) -> Remainder:
        """The process with most evidence beside what was named."""
        left = self._left()
        return Remainder(left.detail, left.magnitude.value, self.left_over)

    @cached_property
    def lag(self) -> Finding | None:
        """The lag between power and speed, where it is beyond usual delays; the likelihood has it in its columns."""
        return lag_finding(self.explanation, self.plain, self.budget.reached)

    def hills(self) -> Finding:
        """The finding of a road that no signal shows, with the share of the gap that a signal could close."""
        slopes = max(float(np.ptp(self.longest.strides.s0)) / SLOPE_LENGTH, 1.0)  # that are independent of each other
        sd = float(np.hypot(self.longest.fit.slope_doubt / np.sqrt(slopes), EFFECT_DOUBT * self.slope_sd))
        part = self.budget.part(ROAD)
        left = self.budget.base if part is None else part.expected
        return Finding(
            name="grade",
            probability=1.0,
            log_bayes_factor=self.explanation.slopes or 0.0,
            equivalent=(),
            magnitude=Magnitude(HIDDEN_GRADE, self.slope_sd, sd, "1"),
            gap_closed=_closed(part),
            rms_before=self.budget.base,
            rms_after=left,
            shift=self._shift,
            detail="varies with place; no signal on the bus shows it",
        )

    def findings(self) -> tuple[Finding, ...]:
        """The road, the effects that are sure, or the one that a "cannot tell" is about, and the lag."""
        road = [] if self.is_road_given or not self.explanation.is_hilly else [self._road()]
        doubtful = self.explained.choices[:1] if self.verdict() is Verdict.CANNOT_TELL else ()
        choices = doubtful if self.is_outdone else self.sure or doubtful
        late = self.lag
        if late is not None:
            least = MAX_FORM_SHARE * late.log_bayes_factor
            choices = tuple(c for c in choices if not c.effect.is_noisy or c.log_bayes_factor > least)
        return (*road, *(self._finding(choice) for choice in choices), *(() if late is None else (late,)))

    def candidates(self, named: Sequence[Finding]) -> tuple[Finding, ...]:
        """All effects, each alone, with their probabilities in the table of models; road, lag, and what has no name."""
        ranking = self.explained.ranking
        others = [finding for finding in named if finding.name not in {one.name for one in ranking}]
        beside = [self._candidate(one, self.explained.probability[one.name], ranking) for one in ranking]
        return tuple(sorted((*others, *beside, self._left()), key=lambda f: -f.log_bayes_factor))

    def _left(self) -> Finding:
        """The nameless process with most evidence in what the chosen effects leave."""
        parts = [part for part in self.budget.parts if part.cause.startswith(UNKNOWN) and part.cause != WHITE]
        rms = float(np.sqrt(sum(part.rms**2 for part in parts))) if parts else float("nan")
        unnamed = self.nameless.processes
        names = [part.cause.removeprefix(UNKNOWN) for part in parts] or [next(iter(unnamed.values())).name]
        return Finding(
            name=Verdict.UNKNOWN.value,
            probability=self.nameless.probability,
            log_bayes_factor=self.left_over,
            equivalent=(),
            magnitude=Magnitude("rms", rms, float("nan"), "W"),
            gap_closed=None,
            rms_before=self.budget.reached,
            rms_after=self.budget.reached,
            shift=None,
            span=tuple(s for n, own in unnamed.items() for s in self._clock(n, own.spans or ())) if parts else (),
            detail=", ".join(self._sized(name) for name in names),
        )

    def _sized(self, name: str) -> str:
        """The name of what has none in the catalogue, with its size where it has a single one."""
        found = [(n, process) for n, process in self.nameless.processes.items() if process.name == name]
        if name not in SWITCHES or not found:
            return name
        number, process = found[0]
        drive = self.explained.drives[number]
        size = drive.joint_with((process,)).posterior(range(len(drive.chosen) + 1)).mean[-1]
        return f"{name} ({size:.0f} {SWITCHES[name]})"

    def _alike(self, one: Ranked, ranking: Sequence[Ranked]) -> set[str]:
        """Names that the drives speak for as well, with a column of the same course, and those declared equivalent."""
        limits, trace = self.thresholds, one.best[1].trace
        others = [other for other in ranking if other is not one and other.gain > limits.min_log_bf_effect]
        near = [o.name for o in others if _correlation(o.best[1].trace, trace) > limits.min_class_correlation]
        return {*near, *one.effect.equivalent}

    def _candidate(self, one: Ranked, probability: float, ranking: Sequence[Ranked]) -> Finding:
        which, form = one.best
        term, effect = form.component.term, one.effect
        return Finding(
            name=one.name,
            probability=probability,
            log_bayes_factor=one.gain,
            equivalent=tuple(sorted(self._alike(one, ranking))),
            magnitude=_magnitude(effect, form.value, form.sd),
            gap_closed=None,
            rms_before=self.budget.base,
            rms_after=self.budget.base,
            shift=None,
            span=() if term is None else self._clock(which, term.spans or ()),
            detail="" if term is None else _detail(term.shape, effect),
        )

    def invisible(self, effects: Sequence[Effect]) -> tuple[Invisible, ...]:
        """Effects that could act at their usual size beside the road without evidence, and the shift they cause."""
        drive, limits = self.longest, self.thresholds
        known, present = frozenset(drive.strides.context), {component.name for component in drive.chosen}
        lasting = [effect for effect in effects if is_lasting(effect) and effect.name not in present]
        frame, ours = Frame.of(drive.fit), range(len(drive.chosen))
        forms = [(effect, form) for effect in lasting for form in of_effect(frame, effect, known)]
        joint = drive.joint_with([form for _, form in forms])
        places = range(len(ours), len(ours) + len(forms))
        sds = joint.gains(ours, places).sd
        jacobian = theta_jacobian(joint.posterior(ours).mean[: joint.base_size], 0)
        best: dict[str, Invisible] = {}
        for place, sd, (effect, form) in zip(places, sds.tolist(), forms, strict=True):
            strength = float(np.sqrt(max((form.sd / sd) ** 2 - 1.0, 0.0)))  # less the prior's own
            A, C, m, *_ = (jacobian @ joint.imitated(ours, place)[: joint.base_size] * form.sd).tolist()
            found = Invisible(effect.name, evidence_of(strength), Shift(mass=m, A=A, C=C), effect.breaks)
            most = best.setdefault(effect.name, found)
            if found.expected_log_bayes_factor > most.expected_log_bayes_factor:
                best[effect.name] = found
        return tuple(one for one in best.values() if one.expected_log_bayes_factor < limits.min_expected_log_bf)

    def _clock(self, which: int, spans: Spans) -> tuple[Span, ...]:
        """Times of a drive as its log counts them."""
        record = self.plain[which].record
        return tuple(Span(a - record.log_start, b - record.log_start, record.log) for a, b in spans)

    def _road(self) -> Finding:
        """The finding of a road with slopes, with the signals that show it, if any do."""
        found, readings = self.hills(), self.longest.fit.scales.readings
        if not readings:
            return found
        part = self.budget.part(ROAD)
        base = self.budget.base
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
            shift=self._shift,
            detail=f"varies with place; {how} {signals}",
        )

    def _rivals(self, choice: Choice) -> tuple[set[str], float]:
        """Effects that may act in place of a choice, and the probability that it, or a single rival, acts."""
        least = self.thresholds.min_probability
        if choice.probability >= least:
            return set(), choice.probability
        if choice.either >= least:
            return {choice.rival}, choice.either
        likely = {name for name, p in self.explained.probability.items() if p > MIN_RIVAL}
        return likely - {other.name for other in self.explained.choices}, choice.probability

    def _finding(self, choice: Choice) -> Finding:
        drive = self.explained.drives[choice.drive]
        place = next(i for i, component in enumerate(drive.chosen) if component.name == choice.name)
        joint = drive.joint
        posterior, at = joint.posterior(range(len(drive.chosen))), joint.places[place][0]
        term = drive.chosen[place].term
        assert term is not None
        part, effect, value = self.budget.part(choice.name), choice.effect, float(posterior.mean[at])
        sd = float(np.hypot(np.sqrt(posterior.covariance[at, at]), EFFECT_DOUBT * value))
        left = self.budget.base if part is None or part.reached is None else part.reached
        rivals, probability = self._rivals(choice)
        spans = [
            span
            for number, each in enumerate(self.explained.drives)
            for component in each.chosen
            if component.name == choice.name
            for span in self._clock(number, component.spans or ())
        ]
        close = {*rivals, Verdict.UNKNOWN.value} if self.is_outdone else rivals
        return Finding(
            name=choice.name,
            probability=probability,
            log_bayes_factor=choice.log_bayes_factor,
            equivalent=tuple(sorted(close | set(effect.equivalent))),
            magnitude=_magnitude(effect, value, sd),
            gap_closed=_closed(part),
            rms_before=self.budget.base,
            rms_after=left,
            shift=self._shift,
            span=tuple(spans),
            detail=_detail(term.shape, effect),
        )


def _closed(part: Part | None) -> GapClosed | None:
    """Share of what is not noise that is gone once the part's cause is known."""
    return None if part is None else GapClosed(*part.closed)


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    """Of two courses, whatever the sign; 0 where one of them is constant, or of another drive."""
    if len(one) != len(other) or not (np.ptp(one) and np.ptp(other)):
        return 0.0
    return abs(float(np.corrcoef(one, other)[0, 1]))


def _magnitude(effect: Effect, value: float, sd: float) -> Magnitude:
    """The magnitude that belongs to a coefficient."""
    if effect.sized is None:
        return Magnitude(effect.symbol, value, sd, effect.unit)
    low, high = effect.sized(value - sd), effect.sized(value + sd)
    return Magnitude(effect.symbol, effect.sized(value), abs(high - low) / 2, effect.unit)


def _detail(shape: object, effect: Effect) -> str:
    """The shape found, in words."""
    if isinstance(shape, Quantity):
        return shape.value
    return effect.describe(shape) if shape is not None and effect.describe is not None else ""


def conclude(
    explanation: Explanation, plain: tuple[Drive, ...], thresholds: Thresholds, rng: np.random.Generator
) -> Conclusion:
    """Split the gap between what was found; ``rng`` draws from the posterior."""
    drives, explained = explanation.explained.drives, explanation.explained
    late, unnamed = evidence_of_lag(explanation), [explained.nameless]
    if late is not None and low_pass_gain(explanation):
        unnamed.append(explained.beyond_low_pass)
    least = max(thresholds.min_log_bf_unknown, MAX_FORM_SHARE * (late or 0.0))
    counted = [one.processes for one in unnamed if one.log_bayes_factor > least]
    processes = [[own[i] for own in counted if i in own] for i in range(len(drives))]
    possible = [_possible(explanation.explained, i) for i in range(len(drives))]
    terms = [term.effect for drive in plain for term in drive.model.terms]
    given = {ROAD if effect.is_gravity else effect.name for effect in terms}
    split = budget(drives, possible, processes, rng, given)
    if explanation.is_sloping and not explanation.is_hilly:
        split = split.renamed(ROAD, UNKNOWN + FORCE_BY_PLACE)
    if late is not None:
        split = split.renamed(UNKNOWN + LOW_PASS, effect_of(explanation).name)
    return Conclusion(explanation=explanation, budget=split, plain=plain, thresholds=thresholds)


def _with_choices(drive: Drive, state: DriveState) -> Drive:
    present = {term.effect.name for term in drive.model.terms}
    chosen = [one.term for one in state.chosen if one.term is not None and one.term.effect.name not in present]
    return drive.having((*drive.model.terms, *chosen)) if chosen else drive


def _possible(explained: Explained, drive: int) -> list[Component]:
    """Effects that were not chosen but may act: not switched, not noisy, and without clear evidence against them."""
    forms = [one.each[drive] for one in explained.beside]
    return [
        form.component
        for form in forms
        if form is not None
        and form.gain > MIN_LOG_BF_POSSIBLE
        and not form.component.is_noisy
        and form.component.spans is None
    ]

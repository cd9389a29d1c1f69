"""Effects beside the road as a state, judged by one likelihood, and the budget of the gap.

On hills the residual of the plain road load is the road, or the error of an altimeter, and hides all other effects.
There effects are searched beside the road (`components.search`). On a level road the search of the diagnosis has chosen
them already, and the road model only splits the gap between them, the road and the sensors.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.answers.diagnosis import Verdict
from estimator.components.budget import ROAD, UNKNOWN, WHITE, Budget, Part, budget
from estimator.components.component import Component, Frame, of_effect, of_term
from estimator.components.search import AtRest, Choice, DriveState, Explained, Ranked, ranked, search
from estimator.diagnosis.candidates import IDLE_POWER_SD, IDLE_POWER_SHARE
from estimator.diagnosis.isolability import evidence_of, is_lasting
from estimator.diagnosis.multi_drive import Drive
from estimator.diagnosis.outcome import Outcome
from estimator.diagnosis.result import HIDDEN_GRADE, Finding, GapClosed, Invisible, Magnitude, Shift, Span
from estimator.diagnosis.thresholds import Thresholds
from estimator.estimation.road_evidence import log_bayes_factor_of_road, log_bayes_factor_of_signals
from estimator.estimation.road_fit import theta_jacobian
from estimator.estimation.road_likelihood import ROAD_LOAD
from estimator.model.design_matrix import Spans
from estimator.model.effects import Effect
from estimator.signals import Quantity

MIN_LOG_BF_POSSIBLE = -3.0  # log Bayes factor from which an effect that was not chosen is part of the budget
FORCE_BY_PLACE = f"{UNKNOWN}force over distance"  # what the road as a state takes up where something else acts
SLOPE_LENGTH = 300.0  # m, after which a road has another slope


@dataclass(frozen=True, kw_only=True)
class BesideRoad:
    """The drives explained with the road as a state, the best remaining process, and the budget."""

    explained: Explained
    left_over: float  # log Bayes factor of the best nameless process beside what was chosen
    budget: Budget
    plain: tuple[Drive, ...]
    thresholds: Thresholds
    is_on_hills: bool  # whether the effects were searched beside the road

    @property
    def longest(self) -> DriveState:
        """The drive with most strides, which figures of a single drive are taken from."""
        return max(self.explained.drives, key=lambda drive: len(drive.fit.strides))

    @property
    def slope_sd(self) -> float:
        """Standard deviation of the road's slope [1]."""
        return self.longest.fit.slope_sd

    @property
    def road_load(self) -> tuple[Shift, Shift]:
        """A, C, m with the road as a state, and their standard deviations."""
        fit = self.longest.fit
        A, C, m = fit.theta[:ROAD_LOAD].tolist()
        dA, dC, dm = np.sqrt(np.diag(fit.theta_covariance()))[:ROAD_LOAD].tolist()
        return Shift(mass=m, A=A, C=C), Shift(mass=dm, A=dA, C=dC)

    @property
    def is_given(self) -> bool:
        """Whether the road is part of the model from the start."""
        return any(term.effect.is_gravity for drive in self.plain for term in drive.model.terms)

    @property
    def rms_base(self) -> float:
        """Residual [W] of the model without the effects found."""
        part = self.budget.part(ROAD) if self.is_given else None
        return self.budget.total if part is None or part.reached is None else part.reached

    @property
    def _shift(self) -> Shift:
        """Shift of the parameters from the plain model to the one with the road and all chosen effects."""
        model = max((drive.model for drive in self.plain), key=lambda model: len(model.samples))
        A, C, m = model.road_load.tolist()
        final, _ = self.road_load
        return Shift(mass=final.mass - m, A=final.A - A, C=final.C - C)

    def verdict(self) -> Verdict:
        """An effect where effects were chosen or the road is new in the model; else by the best remaining process."""
        if self.explained.choices or not self.is_given:
            return Verdict.EFFECT
        return Verdict.UNKNOWN if self.left_over > self.thresholds.min_log_bf_left_process else Verdict.NO_GAP

    def hills(self, log_bayes_factor: float) -> Finding:
        """The finding of a road that no signal shows, with the share of the gap that a signal could close."""
        driven = float(np.ptp(self.longest.strides.s0))
        spread = float(np.sqrt(0.5 * SLOPE_LENGTH / max(driven, SLOPE_LENGTH)))  # of a standard deviation
        part = self.budget.part(ROAD)
        left = self.budget.total if part is None else part.expected
        return Finding(
            name="grade",
            probability=self.thresholds.probabilities([log_bayes_factor])[0],
            log_bayes_factor=log_bayes_factor,
            equivalent=(),
            magnitude=Magnitude(HIDDEN_GRADE, self.slope_sd, self.slope_sd * spread, "1"),
            gap_closed=self._closed(part, left),
            rms_before=self.budget.total,
            rms_after=left,
            shift=self._shift,
            detail="varies with place; no signal on the bus shows it",
        )

    def findings(self, before: Sequence[Finding | None]) -> tuple[Finding, ...]:
        """The road, as it was found ``before``, and the effects that were chosen beside it."""
        found = [finding for finding in before if finding is not None and finding.name == "grade"]
        road = [self._road(found[0])] if found else [] if self.is_given else [self._shown_hills()]
        return (*road, *(self._finding(choice) for choice in self.explained.choices))

    def candidates(self, named: Sequence[Finding]) -> tuple[Finding, ...]:
        """Road and lag, if they are ``named``, all effects as they were judged beside them at first, and what is left.

        The road does not exclude an effect: the probabilities of effects compare them with one another, and with what
        is left when all that were chosen are in the model.
        """
        choices = self.explained.choices
        ranking = choices[0].ranking if choices else self.explained.ranking
        *shares, unknown, _ = self.thresholds.probabilities([*(one.gain for one in ranking), self.left_over])
        others = [finding for finding in named if finding.name not in {one.name for one in ranking}]
        beside = [self._candidate(one, share, ranking) for one, share in zip(ranking, shares, strict=True)]
        left = self._left(unknown)
        return tuple(sorted((*others, *beside, left), key=lambda finding: -finding.log_bayes_factor))

    def _left(self, probability: float) -> Finding:
        """The nameless process with most evidence in what the chosen effects leave."""
        parts = [part for part in self.budget.parts if part.cause.startswith(UNKNOWN) and part.cause != WHITE]
        rms = float(np.sqrt(sum(part.rms**2 for part in parts))) if parts else float("nan")
        return Finding(
            name=Verdict.UNKNOWN.value,
            probability=probability,
            log_bayes_factor=self.left_over,
            equivalent=(),
            magnitude=Magnitude("rms", rms, float("nan"), "W"),
            gap_closed=None,
            rms_before=self.budget.reached,
            rms_after=self.budget.reached,
            shift=None,
            detail=", ".join(part.cause.removeprefix(UNKNOWN) for part in parts),
        )

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
            magnitude=Magnitude(effect.symbol, form.value, form.sd, effect.unit),
            gap_closed=None,
            rms_before=self.budget.total,
            rms_after=self.budget.total,
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
        joint = drive.joint([form for _, form in forms])
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

    def _shown_hills(self) -> Finding:
        """The finding of a road that signals show too poorly for the search on the level road."""
        fits = [(drive.strides, drive.fit) for drive in self.explained.drives]
        found = self.hills(sum(log_bayes_factor_of_road(strides, fit) for strides, fit in fits))
        size = replace(found.magnitude, name="slope")
        signals = ", ".join(name.replace("_", " ") for name in self.longest.fit.scales.readings)
        return self._road(replace(found, magnitude=size, detail=f"varies with place; shown in part by {signals}"))

    def _road(self, found: Finding) -> Finding:
        if found.magnitude.name == HIDDEN_GRADE:
            return self.hills(found.log_bayes_factor)
        part = self.budget.part(ROAD)
        reached = self.budget.total if part is None or part.reached is None else part.reached
        closed = self._closed(part, reached)
        return replace(found, gap_closed=closed, rms_before=self.budget.total, rms_after=reached, shift=self._shift)

    def _finding(self, choice: Choice) -> Finding:
        best, ranking = choice.ranked, choice.ranking
        which, _ = best.best
        drive = self.explained.drives[which]
        place = next(i for i, component in enumerate(drive.chosen) if component.name == best.name)
        joint = drive.joint()
        posterior, at = joint.posterior(range(len(drive.chosen))), joint.places[place][0]
        term = drive.chosen[place].term
        assert term is not None
        part, effect = self.budget.part(best.name), term.effect
        alone = self.budget.total if part is None or part.reached is None else part.reached
        left = self.budget.reached if self.is_given else alone
        limits, others = self.thresholds, [other for other in ranking if other is not best]
        close = {other.name for other in others if other.gain > best.gain - limits.min_log_bf_lead}
        return Finding(
            name=best.name,
            probability=limits.probabilities([best.gain, *(other.gain for other in others)])[0],
            log_bayes_factor=best.gain,
            equivalent=tuple(sorted(close | self._alike(best, ranking))),
            magnitude=Magnitude(
                effect.symbol, posterior.mean[at], float(np.sqrt(posterior.covariance[at, at])), effect.unit
            ),
            gap_closed=self._closed(part, left),
            rms_before=self.rms_base,
            rms_after=left,
            shift=None,
            span=self._clock(which, term.spans or ()),
            detail=_detail(term.shape, effect),
        )

    def _closed(self, part: Part | None, left: float) -> GapClosed | None:
        """Share of what lies above the noise that is gone when ``left`` [W] is left; as unsure as the part's share."""
        floor = self.budget.floor**2
        gap = self.rms_base**2 - floor
        if part is None or gap <= 0:
            return None
        closed, unit = 1 - (left**2 - floor) / gap, self.budget.total**2 / gap
        low, high = closed - (part.share - part.q05) * unit, closed + (part.q95 - part.share) * unit
        share, q05, q95 = np.clip([closed, low, high], 0.0, 1.0).tolist()
        return GapClosed(share, q05, q95)


def _correlation(one: np.ndarray, other: np.ndarray) -> float:
    return 0.0 if len(one) != len(other) else abs(float(np.corrcoef(one, other)[0, 1]))


def _detail(shape: object, effect: Effect) -> str:
    """The shape found, in words."""
    if isinstance(shape, Quantity):
        return shape.value
    return effect.describe(shape) if shape is not None and effect.describe is not None else ""


def beside_road(outcome: Outcome) -> BesideRoad | None:
    """Explain the drives of an outcome with the road as a state; None where it cannot be fitted."""
    plain = [_state(drive) for drive in outcome.plain]
    states = tuple(state for state in plain if state is not None)
    if len(states) < len(plain):
        return None
    effects = [effect for effect in outcome.effects if not effect.absorbed and not effect.is_gravity]
    explained, is_on_hills = _explained(outcome, states, effects)
    unnamed = [drive.unnamed() for drive in explained.drives]
    left = max(found[1] for found in unnamed if found is not None)
    least = outcome.thresholds.min_log_bf_left_process
    counted = [found[0] if found is not None and found[1] > least else None for found in unnamed]
    possible = [_possible(explained, i) for i in range(len(states))]
    split = budget(explained.drives, possible, counted, outcome.rng)
    if not is_on_hills and outcome.verdict is Verdict.UNKNOWN:
        split = split.renamed(ROAD, FORCE_BY_PLACE)
    return BesideRoad(
        explained=explained,
        left_over=left,
        budget=split,
        plain=outcome.plain,
        thresholds=outcome.thresholds,
        is_on_hills=is_on_hills,
    )


def _explained(outcome: Outcome, states: Sequence[DriveState], effects: Sequence[Effect]) -> tuple[Explained, bool]:
    """The drives with what acts beside the road, and whether it was searched there: on hills.

    The search on the level road may miss hills that a signal shows poorly, and effects with them. An unmodelled force
    may look like hills as well, but signals of the road do not follow it.
    """
    limits = outcome.thresholds
    if outcome.is_on_hills:
        return search(states, effects, limits.min_log_bf_beside_road), True
    known = tuple(map(_with_terms, states, outcome.final))
    if any(state.fit.scales.readings and state.fit.slope_sd > limits.min_grade_sd for state in known):
        beside = search(states, effects, limits.min_log_bf_beside_road)
        shown = [drive for drive in beside.drives if drive.fit.scales.readings]
        if sum(log_bayes_factor_of_signals(drive.strides, drive.fit) for drive in shown) > limits.min_log_bf_effect:
            return beside, True
    return Explained(known, (), ranked(known, effects)), False


def _state(drive: Drive) -> DriveState | None:
    """The drive with the effects that are part of the model from the start."""
    idling = drive.record.idling
    rest = None if idling is None else AtRest(idling[0], IDLE_POWER_SD + IDLE_POWER_SHARE * abs(idling[0]), idling[1])
    state = DriveState.of(drive.record.strides, rest)
    return None if state is None else _with_terms(state, drive)


def _with_terms(state: DriveState, drive: Drive) -> DriveState:
    """The state with the effects of the drive's model, except gravity (the road) and absorbed effects (the fit)."""
    frame = Frame.of(state.fit)
    terms = [term for term in drive.model.terms if not (term.effect.is_gravity or term.effect.absorbed)]
    return state.having(tuple(of_term(frame, term) for term in terms)) if terms else state


def _possible(explained: Explained, drive: int) -> list[Component]:
    """Effects that were not chosen but may act: not switched, not noisy, and without clear evidence against them."""
    forms = [one.each[drive] for one in explained.ranking]
    return [
        form.component
        for form in forms
        if form is not None
        and form.gain > MIN_LOG_BF_POSSIBLE
        and not form.component.is_noisy
        and not _is_timed(form.component)
    ]


def _is_timed(component: Component) -> bool:
    return component.term is not None and component.term.spans is not None

"""Conclusion from an explanation: the verdict, the named effects, and the budget of the gap."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from estimator.answers.diagnosis import Verdict
from estimator.components.budget import ROAD, UNKNOWN, Budget, budget
from estimator.components.drive_state import DriveState
from estimator.components.explained import Choice, Explained, Nameless
from estimator.components.plain_model import PlainModel
from estimator.components.processes import LOW_PASS
from estimator.components.term import Term
from estimator.diagnosis.case import Case
from estimator.diagnosis.explanation import Explanation
from estimator.diagnosis.lag import effect_of, evidence_of_lag, lag_finding, low_pass_gain
from estimator.diagnosis.result import Finding, Shift
from estimator.diagnosis.thresholds import Thresholds
from estimator.estimation.road_likelihood import ROAD_LOAD
from estimator.estimation.shapes import averaged

MIN_LOG_BF_POSSIBLE = -3.0  # log Bayes factor above which an effect that was not chosen is part of the budget
FORCE_BY_PLACE = "force over distance"  # cause in the budget of slopes that are not those of a road
MAX_FORM_SHARE = 0.05  # of the evidence of a lag: an error of its form gives effects computed from power up to that


@dataclass(frozen=True, kw_only=True)
class Conclusion:
    """An ``explanation`` of ``cases``, the ``budget`` of the gap, and the ``thresholds`` of the verdict."""

    explanation: Explanation
    budget: Budget
    cases: tuple[Case, ...]
    thresholds: Thresholds

    @property
    def explained(self) -> Explained:
        """The drives with the most probable hypothesis, and the evidence for it."""
        return self.explanation.explained

    @property
    def longest(self) -> DriveState:
        """The drive with most strides; results that hold for a single drive are taken from it."""
        return self.explanation.longest

    @property
    def sure(self) -> tuple[Choice, ...]:
        """The chosen effects that act with at least the probability to name them, alone or together with a rival."""
        return tuple(c for c in self.explained.choices if c.either >= self.thresholds.min_probability)

    @property
    def left_over(self) -> float:
        """Log Bayes factor of a nameless process beside the chosen effects, or of a force that varies with place.

        The larger of the two.
        """
        return max(self.nameless.log_bayes_factor, self.by_place)

    @property
    def nameless(self) -> Nameless:
        """The nameless process with most evidence; if the lag is named, a low-pass of the speed is not one of them."""
        return self.explained.nameless if self.lag is None else self.explained.beyond_low_pass

    @property
    def by_place(self) -> float:
        """Log Bayes factor of slopes that are not those of a road, hence a force that varies with place; 0 if none."""
        is_force = self.explanation.is_sloping and not self.explanation.is_hilly
        return (self.explanation.slopes or 0.0) if is_force else 0.0

    @cached_property
    def road_load(self) -> tuple[Shift, Shift]:
        """A, C, m of the longest drive with all chosen effects, and their sd.

        Averaged over the hypotheses of the table and over shapes; the road is a state unless it is level.
        """
        others = self.explained.others[self.explanation.which]
        fit = averaged(self.longest.strides, self.longest.fit).mixed(others.shift, others.covariance)
        A, C, m = fit.theta[:ROAD_LOAD].tolist()
        dA, dC, dm = np.sqrt(np.diag(fit.theta_covariance()))[:ROAD_LOAD].tolist()
        return Shift(mass=m, A=A, C=C), Shift(mass=dm, A=dA, C=dC)

    @cached_property
    def plain(self) -> tuple[Shift, Shift]:
        """A, C, m of the plain model of the longest drive, and their sd; the budget splits its residual."""
        (A, C, m), (dA, dC, dm) = (values.tolist() for values in PlainModel(self.longest.fit).road_load)
        return Shift(mass=m, A=A, C=C), Shift(mass=dm, A=dA, C=dC)

    @property
    def shift(self) -> Shift:
        """Change of A, C and m from the plain model to the one with the road and all chosen effects."""
        (base, _), (final, _) = self.plain, self.road_load
        return Shift(mass=final.mass - base.mass, A=final.A - base.A, C=final.C - base.C)

    @property
    def is_road_given(self) -> bool:
        """True if the configuration gives the road."""
        return self.cases[0].is_road_given

    @property
    def is_road_found(self) -> bool:
        """True if there are hills and the configuration does not give the road."""
        return self.explanation.is_hilly and not self.is_road_given

    def verdict(self) -> Verdict:
        """Verdict by the table of models.

        No effect is named if processes alone have more evidence than the effects alone; the road and the lag are.
        """
        limits = self.thresholds
        if self.is_road_found or self.lag is not None or (self.sure and not self.is_outdone):
            return Verdict.EFFECT
        if self.left_over > limits.min_log_bf_unknown:
            return Verdict.UNKNOWN
        return Verdict.NO_GAP if self.explained.none >= limits.min_probability_no_gap else Verdict.CANNOT_TELL

    @property
    def named(self) -> tuple[Choice, ...]:
        """The effects that are probable enough to be named, or the likeliest one if the verdict is "cannot tell".

        Where a lag is named, an effect computed from power needs more evidence than an error of the lag's form gives.
        """
        doubtful = self.explained.choices[:1] if self.verdict() is Verdict.CANNOT_TELL else ()
        choices = doubtful if self.is_outdone else self.sure or doubtful
        return tuple(c for c in choices if not c.effect.is_noisy or c.log_bayes_factor > self._error_of_lag)

    @property
    def _error_of_lag(self) -> float:
        return _evidence_by_error_of(None if self.lag is None else self.lag.log_bayes_factor)

    @property
    def is_outdone(self) -> bool:
        """True if the best processes alone have more evidence than the best effects alone.

        Processes count if one acts with a probability above `min_probability_no_gap`; a force that varies with place
        always counts. Where a lag is named, the evidence of a low-pass of the speed counts for the effects.
        """
        likely = self.nameless.probability > self.thresholds.min_probability_no_gap
        by_processes = self.explained.by_processes if likely else 0.0
        bent = 0.0 if self.lag is None else low_pass_gain(self.explanation)
        return self.explained.by_effects + bent < max(by_processes, self.by_place)

    def remaining(self) -> Verdict:
        """Verdict on what the named effects leave: "unknown effect" or "no gap".

        The evidence of nameless processes has to be above the limit and above what errors of form can give.
        """
        least = max(self.thresholds.min_log_bf_left, self._error_of_lag, self.explained.error_of_form)
        return Verdict.UNKNOWN if self.left_over > least else Verdict.NO_GAP

    @cached_property
    def lag(self) -> Finding | None:
        """Lag between power and speed if it is beyond usual delays, else None; every fit has a column for it."""
        return lag_finding(self.explanation, self.budget)


def _evidence_by_error_of(lag: float | None) -> float:
    """Log Bayes factor that errors of form of a lag can give effects computed from power; -inf without a lag.

    ``lag``: log Bayes factor of the lag.
    """
    return -np.inf if lag is None else MAX_FORM_SHARE * lag


def conclude(
    explanation: Explanation, cases: tuple[Case, ...], thresholds: Thresholds, rng: np.random.Generator
) -> Conclusion:
    """Conclusion from an ``explanation``, with the gap split between its effects, processes and road.

    ``rng`` draws from the posterior.
    """
    drives, explained = explanation.explained.drives, explanation.explained
    late, unnamed = evidence_of_lag(explanation), [explained.nameless]
    if late is not None and low_pass_gain(explanation):
        unnamed.append(explained.beyond_low_pass)
    elif late is not None and explained.low_pass is not None:  # another process has more evidence
        unnamed.append(explained.low_pass)
    least = max(thresholds.min_log_bf_unknown, _evidence_by_error_of(late))
    counted = [one.processes for one in unnamed if one.log_bayes_factor > least]
    processes = [[own[i] for own in counted if i in own] for i in range(len(drives))]
    possible = [_possible(explanation.explained, i) for i in range(len(drives))]
    given = {effect_term.effect.name for case in cases for effect_term in case.terms} | (
        {ROAD} if cases[0].is_road_given else set()
    )
    split = budget(drives, possible, processes, rng, given)
    if explanation.is_sloping and not explanation.is_hilly:
        split = split.renamed(ROAD, UNKNOWN + FORCE_BY_PLACE)
    if late is not None:
        split = split.renamed(UNKNOWN + LOW_PASS, effect_of(explanation).name)
    return Conclusion(explanation=explanation, budget=split, cases=cases, thresholds=thresholds)


def _possible(explained: Explained, drive: int) -> list[Term]:
    """Effects that were not chosen but may act on a ``drive`` (its number).

    Their log Bayes factor is above MIN_LOG_BF_POSSIBLE, they have no fitted times, and their column is not computed
    from the measured force.
    """
    forms = [one.each[drive] for one in explained.beside]
    return [
        form.term
        for form in forms
        if form is not None and form.gain > MIN_LOG_BF_POSSIBLE and not form.term.is_noisy and form.term.spans is None
    ]

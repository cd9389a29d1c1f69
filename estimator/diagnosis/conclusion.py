"""What is concluded from an explanation: the verdict, what is named, and the budget of the gap."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from estimator.answers.diagnosis import Verdict
from estimator.components.budget import ROAD, UNKNOWN, Budget, budget
from estimator.components.component import Component
from estimator.components.drive_state import DriveState
from estimator.components.explained import Choice, Explained, Nameless
from estimator.components.plain_model import PlainModel
from estimator.components.processes import LOW_PASS
from estimator.diagnosis.case import Case
from estimator.diagnosis.explanation import Explanation
from estimator.diagnosis.lag import effect_of, evidence_of_lag, lag_finding, low_pass_gain
from estimator.diagnosis.result import Finding, Shift
from estimator.diagnosis.thresholds import Thresholds
from estimator.estimation.road_likelihood import ROAD_LOAD
from estimator.estimation.shapes import averaged

MIN_LOG_BF_POSSIBLE = -3.0  # log Bayes factor from which an effect that was not chosen is part of the budget
FORCE_BY_PLACE = "force over distance"  # what slopes are that no road has
MAX_FORM_SHARE = 0.05  # of the evidence of a lag: errors of its form give as much to effects computed from power


@dataclass(frozen=True, kw_only=True)
class Conclusion:
    """An explanation of ``cases``, and the budget of the gap."""

    explanation: Explanation
    budget: Budget
    cases: tuple[Case, ...]
    thresholds: Thresholds

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

    @cached_property
    def road_load(self) -> tuple[Shift, Shift]:
        """A, C, m with the road as a state, averaged over sets of effects and over shapes, and their sd."""
        others = self.explained.others[self.explanation.which]
        fit = averaged(self.longest.strides, self.longest.fit).mixed(others.shift, others.covariance)
        A, C, m = fit.theta[:ROAD_LOAD].tolist()
        dA, dC, dm = np.sqrt(np.diag(fit.theta_covariance()))[:ROAD_LOAD].tolist()
        return Shift(mass=m, A=A, C=C), Shift(mass=dm, A=dA, C=dC)

    @cached_property
    def plain(self) -> tuple[Shift, Shift]:
        """A, C, m of the plain model, which the budget splits the residual of, and their sd; of the longest drive."""
        (A, C, m), (dA, dC, dm) = (values.tolist() for values in PlainModel(self.longest.fit).road_load)
        return Shift(mass=m, A=A, C=C), Shift(mass=dm, A=dA, C=dC)

    @property
    def shift(self) -> Shift:
        """Of the parameters, from the plain model to the one with the road and all chosen effects."""
        (base, _), (final, _) = self.plain, self.road_load
        return Shift(mass=final.mass - base.mass, A=final.A - base.A, C=final.C - base.C)

    @property
    def is_road_given(self) -> bool:
        """Whether the road is part of the model from the start."""
        return self.cases[0].is_road_given

    @property
    def is_road_found(self) -> bool:
        """Whether there are hills that are not part of the model from the start."""
        return self.explanation.is_hilly and not self.is_road_given

    def verdict(self) -> Verdict:
        """Read from the table of models.

        Effects are named unless processes without them explain more than they do.
        """
        limits = self.thresholds
        if self.is_road_found or self.lag is not None or (self.sure and not self.is_outdone):
            return Verdict.EFFECT
        if self.left_over > limits.min_log_bf_unknown:
            return Verdict.UNKNOWN
        return Verdict.NO_GAP if self.explained.none >= limits.min_probability_no_gap else Verdict.CANNOT_TELL

    @property
    def named(self) -> tuple[Choice, ...]:
        """The effects that are sure, or the one that a "cannot tell" is about.

        Beside a lag, those computed from power need more evidence than errors of its form give.
        """
        doubtful = self.explained.choices[:1] if self.verdict() is Verdict.CANNOT_TELL else ()
        choices = doubtful if self.is_outdone else self.sure or doubtful
        return tuple(c for c in choices if not c.effect.is_noisy or c.log_bayes_factor > self._error_of_lag)

    @property
    def _error_of_lag(self) -> float:
        return _evidence_by_error_of(None if self.lag is None else self.lag.log_bayes_factor)

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
        """Whether something without a name is left beside what was named, more than errors of the form of that."""
        least = max(self.thresholds.min_log_bf_left, self._error_of_lag, self.explained.error_of_form)
        return Verdict.UNKNOWN if self.left_over > least else Verdict.NO_GAP

    @cached_property
    def lag(self) -> Finding | None:
        """The lag between power and speed, where it is beyond usual delays; the likelihood has it in its columns."""
        return lag_finding(self.explanation, self.budget)


def _evidence_by_error_of(lag: float | None) -> float:
    """Evidence that errors of the form of a lag, of this evidence, give to what is computed from power."""
    return -np.inf if lag is None else MAX_FORM_SHARE * lag


def conclude(
    explanation: Explanation, cases: tuple[Case, ...], thresholds: Thresholds, rng: np.random.Generator
) -> Conclusion:
    """Split the gap between what was found; ``rng`` draws from the posterior."""
    drives, explained = explanation.explained.drives, explanation.explained
    late, unnamed = evidence_of_lag(explanation), [explained.nameless]
    if late is not None and low_pass_gain(explanation):
        unnamed.append(explained.beyond_low_pass)
    elif late is not None and explained.low_pass is not None:  # something else without a name explains more
        unnamed.append(explained.low_pass)
    least = max(thresholds.min_log_bf_unknown, _evidence_by_error_of(late))
    counted = [one.processes for one in unnamed if one.log_bayes_factor > least]
    processes = [[own[i] for own in counted if i in own] for i in range(len(drives))]
    possible = [_possible(explanation.explained, i) for i in range(len(drives))]
    given = {term.effect.name for case in cases for term in case.terms} | ({ROAD} if cases[0].is_road_given else set())
    split = budget(drives, possible, processes, rng, given)
    if explanation.is_sloping and not explanation.is_hilly:
        split = split.renamed(ROAD, UNKNOWN + FORCE_BY_PLACE)
    if late is not None:
        split = split.renamed(UNKNOWN + LOW_PASS, effect_of(explanation).name)
    return Conclusion(explanation=explanation, budget=split, cases=cases, thresholds=thresholds)


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

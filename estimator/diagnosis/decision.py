"""Decide on the result of a search: the verdict, the named effects, and the budget of the gap."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import expit

from estimator.answers.diagnosis import Verdict
from estimator.components.budget import ROAD, UNKNOWN, Budget, budget
from estimator.components.drive_state import DriveState
from estimator.components.plain_model import PlainModel
from estimator.components.processes import LOW_PASS
from estimator.components.search_result import ChosenEffect, NamelessProcess, SearchResult
from estimator.components.term import Term
from estimator.diagnosis.case import Case
from estimator.diagnosis.lag import evidence_of_lag, lag_effect, lag_finding, log_bf_low_pass
from estimator.diagnosis.result import Finding, Shift
from estimator.diagnosis.thresholds import Thresholds
from estimator.estimation.road_likelihood import ROAD_LOAD
from estimator.estimation.shapes import averaged
from estimator.signals import Floats

MIN_LOG_BF_POSSIBLE = -3.0  # log Bayes factor above which an effect that was not chosen is part of the budget
FORCE_BY_PLACE = "force over distance"  # cause in the budget of slopes that are not those of a road
MAX_FORM_SHARE = 0.05  # of the evidence of a lag: an error of its form gives effects computed from power up to that


@dataclass(frozen=True, kw_only=True)
class Decision:
    """Verdict and named effects by ``thresholds``, from the ``result`` of a search on ``cases`` and the ``budget``.

    ``start``: the fits of the cases without any effect but the given ones, which the search started from.
    """

    result: SearchResult
    budget: Budget
    cases: tuple[Case, ...]
    start: tuple[DriveState, ...]
    thresholds: Thresholds

    @property
    def longest(self) -> DriveState:
        """The drive with most strides; results that hold for a single drive are taken from it."""
        return self.result.longest

    @property
    def nameable(self) -> tuple[ChosenEffect, ...]:
        """The chosen effects that act with at least the probability to name them, alone or together with a rival."""
        least = self.thresholds.min_probability
        return tuple(effect for effect in self.result.chosen if effect.probability_with_rival >= least)

    @property
    def log_bf_unknown(self) -> float:
        """Log Bayes factor of a nameless process beside the chosen effects, or of a force that varies with place.

        The larger of the two.
        """
        return max(self.nameless.log_bayes_factor, self.log_bf_force_by_place)

    @property
    def nameless(self) -> NamelessProcess:
        """The nameless process with most evidence; if the lag is named, a low-pass of the speed is not one of them."""
        return self.result.nameless if self.lag is None else self.result.beyond_low_pass

    @property
    def log_bf_force_by_place(self) -> float:
        """Log Bayes factor of slopes that are not those of a road, hence a force that varies with place; 0 if none."""
        is_force = self.result.is_sloping and not self.result.is_hilly
        return (self.result.slopes or 0.0) if is_force else 0.0

    @property
    def probability_of_unknown(self) -> float:
        """Probability that a nameless process acts, or a force that varies with place.

        The prior log odds of a sloping road, whose slopes that force takes, are minus `min_log_bf_slopes`.
        """
        odds_of_force = self.log_bf_force_by_place - self.thresholds.min_log_bf_slopes
        no_force = float(expit(-odds_of_force)) if self.log_bf_force_by_place else 1.0
        return 1.0 - (1.0 - self.nameless.probability) * no_force

    @cached_property
    def road_load(self) -> tuple[Shift, Shift]:
        """A, C, m of the longest drive with all chosen effects, and their sd.

        Averaged over the hypotheses of the table and over shapes; the road is a state unless it is level.
        """
        others = self.result.other_hypotheses[self.result.longest_number]
        fit = averaged(self.longest.strides, self.longest.fit).mixed(others.shift, others.covariance)
        return _stated(fit.theta, np.sqrt(np.diag(fit.theta_covariance())))

    @cached_property
    def base_road_load(self) -> tuple[Shift, Shift]:
        """A, C, m of the longest drive by the plain model, or by the fit with the given effects, and their sd."""
        number = self.result.longest_number
        if not self.cases[number].given:
            return _stated(*PlainModel(self.longest.fit).road_load)
        start = self.start[number]
        fit = averaged(start.strides, start.fit)
        return _stated(fit.theta, np.sqrt(np.diag(fit.theta_covariance())))

    @property
    def shift(self) -> Shift:
        """Change of A, C and m from the model of `base_road_load` to the one with the road and all chosen effects."""
        (base, _), (final, _) = self.base_road_load, self.road_load
        return Shift(mass=final.mass - base.mass, A=final.A - base.A, C=final.C - base.C)

    @property
    def is_road_given(self) -> bool:
        """True if the configuration gives the road."""
        return self.cases[0].is_road_given

    @property
    def is_road_named(self) -> bool:
        """True if there are hills and the configuration does not give the road."""
        return self.result.is_hilly and not self.is_road_given

    def verdict(self) -> Verdict:
        """Verdict by the table of models.

        No effect is named if processes alone have more evidence than the effects alone; the road and the lag are.
        """
        limits = self.thresholds
        if self.is_road_named or self.lag is not None or (self.nameable and not self.nameless_explains_more):
            return Verdict.EFFECT
        if self.log_bf_unknown > limits.min_log_bf_unknown:
            return Verdict.UNKNOWN
        return (
            Verdict.NO_GAP if self.result.probability_of_none >= limits.min_probability_no_gap else Verdict.CANNOT_TELL
        )

    @property
    def named(self) -> tuple[ChosenEffect, ...]:
        """The effects that are probable enough to be named, or the likeliest one if the verdict is "cannot tell".

        Where a lag is named, an effect computed from power needs more evidence than an error of the lag's form gives.
        """
        doubtful = self.result.chosen[:1] if self.verdict() is Verdict.CANNOT_TELL else ()
        effects = doubtful if self.nameless_explains_more else self.nameable or doubtful
        return tuple(e for e in effects if not e.effect.is_noisy or e.log_bayes_factor > self._error_of_lag)

    @property
    def _error_of_lag(self) -> float:
        return _evidence_by_error_of(None if self.lag is None else self.lag.log_bayes_factor)

    @property
    def nameless_explains_more(self) -> bool:
        """True if the best processes alone have more evidence than the best effects alone.

        Processes count if those of the chosen hypothesis have evidence without its effects: others only add to what
        the effects explain. A force that varies with place always counts. Where a lag is named, the evidence of a
        low-pass of the speed counts for the effects.
        """
        is_independent = self.result.log_bf_chosen_processes > self.thresholds.min_log_bf_unknown
        log_bf_processes = self.result.log_bf_processes if is_independent else 0.0
        log_bf_effects = self.result.log_bf_effects + (0.0 if self.lag is None else log_bf_low_pass(self.result))
        return log_bf_effects < max(log_bf_processes, self.log_bf_force_by_place)

    def remaining(self) -> Verdict:
        """Verdict on what the named effects leave: "unknown effect" or "no gap".

        The evidence of nameless processes has to be above the limit and above what errors of form can give.
        """
        if self.verdict() is Verdict.UNKNOWN:
            return Verdict.UNKNOWN
        least = max(self.thresholds.min_log_bf_left, self._error_of_lag, self.result.error_of_form)
        return Verdict.UNKNOWN if self.log_bf_unknown > least else Verdict.NO_GAP

    @cached_property
    def lag(self) -> Finding | None:
        """Lag between power and speed if it is beyond usual delays, else None; every fit has a column for it."""
        return lag_finding(self.result, self.budget)


def _evidence_by_error_of(lag: float | None) -> float:
    """Log Bayes factor that errors of form of a lag can give effects computed from power; -inf without a lag.

    ``lag``: log Bayes factor of the lag.
    """
    return -np.inf if lag is None else MAX_FORM_SHARE * lag


def _stated(road_load: Floats, sd: Floats) -> tuple[Shift, Shift]:
    """A, C, m and their sd, the first elements of ``road_load`` (p,) and ``sd`` (p,)."""
    (A, C, m), (dA, dC, dm) = road_load[:ROAD_LOAD].tolist(), sd[:ROAD_LOAD].tolist()
    return Shift(mass=m, A=A, C=C), Shift(mass=dm, A=dA, C=dC)


def decide(
    result: SearchResult,
    cases: tuple[Case, ...],
    start: tuple[DriveState, ...],
    thresholds: Thresholds,
    rng: np.random.Generator,
) -> Decision:
    """Decide on the ``result`` of a search, with the gap split between its effects, processes and road.

    ``start``: the fits of the cases that the search started from. ``rng`` draws from the posterior.
    """
    log_bf_lag, unnamed = evidence_of_lag(result), [result.nameless]
    if log_bf_lag is not None and log_bf_low_pass(result):
        unnamed.append(result.beyond_low_pass)
    elif log_bf_lag is not None and result.low_pass is not None:  # another process has more evidence
        unnamed.append(result.low_pass)
    least = max(thresholds.min_log_bf_unknown, _evidence_by_error_of(log_bf_lag))
    counted = [nameless.term_by_drive for nameless in unnamed if nameless.log_bayes_factor > least]
    numbers = range(len(result.drives))
    processes = [[terms[number] for terms in counted if number in terms] for number in numbers]
    possible = [_possible(result, number) for number in numbers]
    given = {effect_term.effect.name for case in cases for effect_term in case.terms}
    if cases[0].is_road_given:
        given.add(ROAD)
    split = budget(result.drives, possible, processes, rng, given)
    if result.is_sloping and not result.is_hilly:
        split = split.renamed(ROAD, UNKNOWN + FORCE_BY_PLACE)
    if log_bf_lag is not None:
        split = split.renamed(UNKNOWN + LOW_PASS, lag_effect(result).name)
    return Decision(result=result, budget=split, cases=cases, start=start, thresholds=thresholds)


def _possible(result: SearchResult, number: int) -> list[Term]:
    """Effects that were not chosen but may act on the drive with this ``number``.

    Their log Bayes factor is above MIN_LOG_BF_POSSIBLE, they have no fitted times, and their column is not computed
    from the measured force.
    """
    tested = [effect.term_by_drive[number] for effect in result.ranking_beside_chosen]
    return [
        fitted.term
        for fitted in tested
        if fitted is not None
        and fitted.gain > MIN_LOG_BF_POSSIBLE
        and not fitted.term.is_noisy
        and fitted.term.spans is None
    ]

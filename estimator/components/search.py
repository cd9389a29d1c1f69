"""Search for the most probable hypothesis: renew the table of models and the scales of road and noise in turn.

Noise scales fitted without the effects are too large, and hide them. The table is therefore made in rounds, each with
hypotheses of one term more. After each round, the scales of road and noise are refitted with the most probable one, and
times of switching effects are proposed again.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from estimator.components.candidate_terms import CandidateTerms, EarlierTerms
from estimator.components.drive_state import DriveState
from estimator.components.hypothesis_space import HypothesisSpace
from estimator.components.model_table import MAX_TERMS, Hypothesis, ModelTable, weigh
from estimator.components.search_result import SearchResult, log_evidence, ranked, search_result
from estimator.model.effects.effect import Effect

MAX_ROUNDS = 20  # of table and scales, each found beside the other
MIN_ROUND_GAIN = 1.0  # in log evidence, for one round more
ROUNDING = (
    1e-6  # of log evidence: by less, a round that finds the same hypothesis and scales again differs by rounding alone
)


@dataclass(frozen=True, kw_only=True)
class _Round:
    """Table of hypotheses of up to ``max_terms`` terms, the one chosen from it, and the drives fitted with that one."""

    max_terms: int
    space: HypothesisSpace
    table: ModelTable
    chosen: Hypothesis
    states: tuple[DriveState, ...]

    @cached_property
    def log_posterior(self) -> float:
        """Log evidence of the chosen hypothesis plus its log prior odds."""
        return log_evidence(self.states) + self.space.log_prior(self.chosen, self.space.groups())

    def expected_log_evidence(self, previous: float) -> float:
        """Log evidence after MAX_TERMS further rounds, each with the gain of this one over ``previous``."""
        value = log_evidence(self.states)
        return value + MAX_TERMS * max(value - previous, 0.0)

    @property
    def as_fitted(self) -> tuple[float, tuple[DriveState, ...]]:
        """Log posterior and fitted drives of this round, without its table."""
        return self.log_posterior, self.states


class _OutOfReachError(Exception):
    """Raised if the search is not expected to reach the required log posterior."""


class Search:
    """Search among hypotheses of ``effects`` and nameless processes, on drives of one vehicle.

    Effects are searched first: a process allowed from the start could absorb an effect before the noise scales are
    refitted.

    Parameters
    ----------
    drives
        Drives, with the given effects as chosen terms.
    effects
        Further effects that may act.
    earlier_terms
        Terms found by other searches on these drives; the search adds its own.
    """

    def __init__(
        self, drives: tuple[DriveState, ...], effects: Sequence[Effect], earlier_terms: EarlierTerms | None = None
    ) -> None:
        self._drives, self._effects, self._earlier_terms = drives, effects, earlier_terms or EarlierTerms()
        self._given = [drive.chosen for drive in drives]
        self._candidates = CandidateTerms(effects, self._given, self._earlier_terms)

    @cached_property
    def effects_only(self) -> tuple[DriveState, ...]:
        """Drives fitted with the most probable effects, without any process."""
        return self._with_effects_only()

    def result(self) -> SearchResult:
        """Search, and return the chosen hypothesis with its evidence."""
        return self._result(self._converged(self.effects_only, with_processes=True, with_stretches=True))

    def result_above(self, min_log_posterior: float) -> SearchResult | None:
        """Search as in `result`; None as soon as the log posterior is not expected to reach ``min_log_posterior``."""
        try:
            effects_only = self._with_effects_only(min_log_posterior)
            last_round = self._converged(effects_only, True, True, min_log_posterior)
        except _OutOfReachError:
            return None
        return self._result(last_round)

    def _result(self, last_round: _Round) -> SearchResult:
        ranking = ranked(self._drives, self._effects)
        return search_result(
            last_round.space, last_round.table, last_round.chosen, last_round.states, ranking, self._effects
        )

    @property
    def _starts(self) -> Iterator[tuple[DriveState, ...]]:
        """Starts of the search: the drives as fitted, and with usual noise if that of a drive is unusual."""
        yield self._drives
        if any(drive.has_unusual_noise for drive in self._drives):
            yield tuple(drive.with_usual_noise() for drive in self._drives)

    def _with_effects_only(self, min_log_posterior: float = -np.inf) -> tuple[DriveState, ...]:
        """Drives fitted with effects only. Tables are not kept, because they take megabytes.

        On a hidden road, the search with stretches also starts from the drives with and without the effects found
        first: effects and stretches can absorb each other.

        Raises
        ------
        _OutOfReachError
            No start would reach ``min_log_posterior``.
        """
        fits = list[tuple[float, tuple[DriveState, ...]]]()
        for start in self._starts:
            with suppress(_OutOfReachError):
                fits.append(self._converged(start, min_log_posterior=min_log_posterior).as_fitted)
                if any(drive.is_road_hidden for drive in start):
                    fits += [self._converged(first, with_stretches=True).as_fitted for first in (fits[-1][1], start)]
        if not fits:
            raise _OutOfReachError
        return max(fits, key=lambda fit: fit[0])[1]

    def _round(self, states: tuple[DriveState, ...], size: int, with_processes: bool, with_stretches: bool) -> _Round:
        """Make a table at the present scales, of hypotheses of up to ``size`` terms, or one more than act already."""
        candidates = [
            self._candidates.on_drive(number, state, with_processes, with_stretches)
            for number, state in enumerate(states)
        ]
        space = HypothesisSpace(states, self._given, candidates)
        start = space.fitted_hypothesis() if with_processes else ()  # processes come to the effects found without them
        max_terms = max(size, len(start) + 1)
        table = weigh(space, space.groups(), min(max_terms, MAX_TERMS), start)
        return _Round(max_terms=max_terms, space=space, table=table, chosen=table.best, states=space.fitted(table.best))

    def _converged(
        self,
        states: tuple[DriveState, ...],
        with_processes: bool = False,
        with_stretches: bool = False,
        min_log_posterior: float = -np.inf,
    ) -> _Round:
        """Round with the highest log posterior, without effects that errors of form explain; its terms are recorded.

        Raises
        ------
        _OutOfReachError
            MAX_TERMS further rounds, each with the gain of the last, would not reach ``min_log_posterior``.
        """
        best = self._best_round(states, with_processes, with_stretches, min_log_posterior)
        for number, state in enumerate(best.states):
            self._earlier_terms.add_drive(number, state)
        chosen = best.space.without_small_gains(best.chosen)
        return best if chosen == best.chosen else replace(best, chosen=chosen, states=best.space.fitted(chosen))

    def _best_round(
        self, states: tuple[DriveState, ...], with_processes: bool, with_stretches: bool, min_log_posterior: float
    ) -> _Round:
        """Renew table and scales in turn, as long as the log posterior rises.

        A hypothesis that is best at the scales of another one may have less evidence at its own scales, or a magnitude
        that is impossible for the refitted vehicle. A round with an impossible magnitude is not kept, but the next one
        starts from its scales.
        """
        best, last, highest = None, None, log_evidence(states)
        value = highest
        for size in range(2, MAX_ROUNDS + 2):
            latest = self._round(states, size, with_processes, with_stretches)
            if latest.expected_log_evidence(log_evidence(states)) < min_log_posterior:
                raise _OutOfReachError
            previous, value = value, latest.log_posterior
            if best is not None and value < highest - ROUNDING:
                break
            last, states = latest, latest.states
            for number, effect_term, magnitude in latest.space.rivals(latest.table):
                self._earlier_terms.add_effect_term(number, effect_term, magnitude)
            if all(state.is_possible(len(given)) for state, given in zip(states, self._given, strict=True)):
                gain, best, highest = value - highest, latest, value
            else:  # a hypothesis that is impossible and stays so gains nothing
                gain = abs(value - previous)
            if len(latest.chosen) < latest.max_terms and gain < MIN_ROUND_GAIN:
                break
        best = best or last
        assert best is not None
        return best

"""Search for the most probable hypothesis: renew the table of models and the scales of road and noise in turn.

Noise scales fitted without the effects are too large, and hide them. The table is therefore made in rounds, each with
hypotheses of up to one term more than act already. After each round, the scales of road and noise are refitted with the
most probable one, and times of switching effects are proposed again.
"""

from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from estimator.components.candidate_terms import CandidateTerms, EarlierTerms
from estimator.components.drive_state import DriveState
from estimator.components.hypothesis_space import HypothesisSpace
from estimator.components.model_table import MAX_TERMS, Hypothesis, ModelTable, weigh
from estimator.components.search_result import SearchResult, log_evidence, ranked, search_result
from estimator.model.effects.effect import Effect

FIRST_TERMS = 2  # at most, of hypotheses in the first round, before any effect acts
MIN_ROUND_GAIN = 3.0  # in log evidence, for one round more
ROUNDING = 1e-6  # of log evidence, by which a round that finds the same hypothesis and scales again may differ

_Fit = tuple[float, tuple[DriveState, ...]]  # log posterior, and the drives fitted


@dataclass(frozen=True, kw_only=True)
class _Round:
    """Table of hypotheses, the one chosen from it, and the drives fitted with that one."""

    space: HypothesisSpace
    table: ModelTable
    chosen: Hypothesis
    states: tuple[DriveState, ...]

    @cached_property
    def log_posterior(self) -> float:
        """Log evidence of the chosen hypothesis plus its log prior odds."""
        return log_evidence(self.states) + self.space.log_prior(self.chosen, self.space.groups())

    @cached_property
    def start_log_posterior(self) -> float:
        """Log posterior of the hypothesis that the round starts with, at the scales that it starts from."""
        return log_evidence(self.space.drives) + self.space.log_prior(
            self.space.fitted_hypothesis(), self.space.groups()
        )

    def expected_log_posterior(self, plain: float) -> float:
        """Log posterior if each of the terms up to MAX_TERMS that are still to come gains as much as this round.

        The gain is over the start of the round, or over the log evidence of the ``plain`` drives, which is more where
        the start has usual noise.
        """
        further = max(MAX_TERMS - len(self.chosen), 1)
        return self.log_posterior + further * max(self.log_posterior - max(self.start_log_posterior, plain), 0.0)

    @property
    def as_fitted(self) -> _Fit:
        """Log posterior and fitted drives of this round, without its table."""
        return self.log_posterior, self.states


class _OutOfReachError(Exception):
    """Raised if the search is not expected to reach the required log posterior; it may go on from ``states``."""

    def __init__(self, states: tuple[DriveState, ...]) -> None:
        super().__init__()
        self.states = states


class Search:
    """Search among hypotheses of ``effects`` and nameless processes, on drives of one vehicle.

    Effects are searched first: a process allowed from the start could absorb an effect before the noise scales are
    refitted. Unusual noise, fitted without effects, may hide them: the search starts from usual noise first.

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
        self._left_out = set[str]()  # names of effects that made all rounds from one start impossible

    @cached_property
    def _start(self) -> tuple[DriveState, ...]:
        return tuple(drive.with_usual_noise() if drive.has_unusual_noise else drive for drive in self._drives)

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
            self.effects_only = self._with_effects_only(min_log_posterior)
            last_round = self._converged(self.effects_only, True, True, min_log_posterior)
        except _OutOfReachError:
            return None
        return self._result(last_round)

    def _result(self, last_round: _Round) -> SearchResult:
        ranking = ranked([drive.bare() for drive in self._drives], self._effects)
        states = tuple(
            state.with_nearer_shapes(len(given)) for state, given in zip(last_round.states, self._given, strict=True)
        )
        return search_result(last_round.space, last_round.table, last_round.chosen, states, ranking, self._effects)

    def _with_effects_only(self, min_log_posterior: float = -np.inf) -> tuple[DriveState, ...]:
        """Drives fitted with effects only. Tables are not kept, because they take megabytes.

        If the noise of the drives is unusual, and remains so beside the effects found from usual noise, the search also
        starts from the drives as they are.

        Raises
        ------
        _OutOfReachError
            The search would not reach ``min_log_posterior``.
        """
        try:
            fits = self._effects_from(self._start, min_log_posterior)
        except _OutOfReachError as error:
            self._start = error.states
            raise
        if all(any(drive.has_unusual_noise for drive in states) for states in (self._drives, fits[0][1])):
            fits += self._effects_from(self._drives, -np.inf)
        return max(fits, key=lambda fit: fit[0])[1]

    def _effects_from(self, start: tuple[DriveState, ...], min_log_posterior: float) -> list[_Fit]:
        """Fit with effects found from a start. On a hidden road, the fits with stretches beside these and beside none.

        Effects and stretches can absorb each other.

        Raises
        ------
        _OutOfReachError
            The search would not reach ``min_log_posterior``.
        """
        found = self._converged(start, min_log_posterior=min_log_posterior).as_fitted
        if not any(drive.is_road_hidden for drive in start):
            return [found]
        return [found, *(self._converged(states, with_stretches=True).as_fitted for states in (found[1], start))]

    def _round(
        self,
        states: tuple[DriveState, ...],
        with_processes: bool,
        with_stretches: bool,
        left_out: Set[str] = frozenset(),
    ) -> _Round:
        """Make a table at the present scales, of hypotheses with up to one term more than act already.

        Effects with names in ``left_out`` are in no hypothesis.
        """
        drives = tuple(state.bare() for state in states)  # what this round computes is not in memory in the next
        candidates = [
            (
                candidate
                for candidate in self._candidates.on_drive(number, drive, with_processes, with_stretches)
                if candidate.term.name not in left_out
            )
            for number, drive in enumerate(drives)
        ]
        space = HypothesisSpace(drives, self._given, candidates)
        fitted = space.fitted_hypothesis()
        starts = [fitted, *self._with_best_pairs(space, fitted)]
        max_terms = min(max(FIRST_TERMS, len(fitted) + 1), MAX_TERMS)
        table = weigh(space, space.groups(), max_terms, starts)
        return _Round(space=space, table=table, chosen=table.best, states=space.fitted(table.best))

    def _with_best_pairs(self, space: HypothesisSpace, fitted: Hypothesis) -> list[Hypothesis]:
        """The hypothesis that the drives were ``fitted`` with, with the best times of two of its effects together."""
        pairs = self._candidates.pairs
        changed = [space.with_times(fitted, number, times) for number in pairs for times in pairs[number]]
        return [hypothesis for hypothesis in changed if hypothesis is not None]

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
            The search is not expected to reach ``min_log_posterior``; see `_Round.expected_log_posterior`.
        """
        best, left_out = None, self._left_out - {term.name for state in states for term in state.chosen}
        while best is None:  # effects that make every round impossible are left out
            best = self._best_round(states, with_processes, with_stretches, min_log_posterior, left_out)
        self._left_out |= left_out
        for number, state in enumerate(best.states):
            self._earlier_terms.add_drive(number, state)
        chosen = best.space.without_small_gains(best.chosen)
        return best if chosen == best.chosen else replace(best, chosen=chosen, states=best.space.fitted(chosen))

    def _best_round(
        self,
        start: tuple[DriveState, ...],
        with_processes: bool,
        with_stretches: bool,
        min_log_posterior: float,
        left_out: set[str],
    ) -> _Round | None:
        """Renew table and scales in turn, as long as the log posterior rises.

        A hypothesis that is best at the scales of another one may have less evidence at its own scales, or be
        impossible for the refitted vehicle. A round with an impossible hypothesis is not kept, but the next one starts
        from its scales. If all are impossible, the result is None, and the effects that make the last one so are added
        to ``left_out``.
        """
        best: _Round | None = None
        highest, highest_impossible, impossible = -np.inf, -np.inf, set[str]()
        states, gain = start, np.inf
        while gain >= MIN_ROUND_GAIN:
            latest = self._round(states, with_processes, with_stretches, left_out)
            if latest.expected_log_posterior(log_evidence(self._drives)) < min_log_posterior:
                raise _OutOfReachError(start if self._impossible(latest.states) else latest.states)
            if states is start and not left_out:  # a start with an effect that is left out is no measure
                highest = latest.start_log_posterior
            value = latest.log_posterior
            if best is not None and value < highest - ROUNDING:
                break
            states = latest.states
            for number, effect_term, magnitude in latest.space.rivals(latest.table):
                self._earlier_terms.add_effect_term(number, effect_term, magnitude)
            impossible = self._impossible(states)
            if impossible:
                gain, highest_impossible = value - highest_impossible, max(value, highest_impossible)
            else:
                gain, best, highest = value - highest, latest, value
        if best is None:
            left_out |= impossible
        return best

    def _impossible(self, states: tuple[DriveState, ...]) -> set[str]:
        """Names of effects beyond their limits, and of those that leave the mass of a drive undetermined."""
        names = set[str]()
        for state, given, drive in zip(states, self._given, self._drives, strict=True):
            names |= state.beyond_limits(len(given))
            if drive.fit.determines_mass and not state.fit.determines_mass:
                names |= state.nearest_to_mass(len(given))
        return names

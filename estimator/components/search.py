"""Which components act: a table of models over effects and nameless processes, beside the scales of road and noise.

Noise whose scale was found without the effects is too large, and hides them. So the table is made in rounds: sets of
one cause more each time, with the scales of road and noise found again beside the most probable set, and times of
effects that switch proposed beside it.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from estimator.components.candidates import Candidates
from estimator.components.drive_state import DriveState
from estimator.components.explained import Explained, explained_by, log_evidence, ranked
from estimator.components.hypotheses import Hypotheses
from estimator.components.model_table import MAX_CAUSES, Chosen, ModelTable, weigh
from estimator.model.effects.effect import Effect

MAX_ROUNDS = 20  # of table and scales, each found beside the other
MIN_ROUND_GAIN = 1.0  # in log evidence, for one round more
ROUNDING = 1e-6  # of log evidence: by less, a round that finds the same set and scales again differs by rounding alone


@dataclass(frozen=True)
class _Converged:
    """The last table, the set chosen from it, and the drives fitted beside that set."""

    joint: Hypotheses
    table: ModelTable
    chosen: Chosen
    states: tuple[DriveState, ...]

    @property
    def log_posterior(self) -> float:
        """Log evidence of the set that was chosen, with its prior odds."""
        return log_evidence(self.states) + self.joint.log_prior(self.chosen, self.joint.causes())

    @property
    def as_fitted(self) -> tuple[float, tuple[DriveState, ...]]:
        """The log posterior and the drives alone."""
        return self.log_posterior, self.states


class _OutOfReachError(Exception):
    """The log posterior that is asked for will not be reached."""


class Search:
    """A search among sets of ``effects`` and nameless processes, on ``drives`` that are one vehicle's.

    A process can hold the place of effects while the noise is fitted beside it. So the noise is first fitted beside
    effects alone, and processes are weighed from there.

    Parameters
    ----------
    drives
        With the effects that are given.
    effects
        That may act besides.
    """

    def __init__(self, drives: tuple[DriveState, ...], effects: Sequence[Effect]) -> None:
        self._drives, self._effects = drives, effects
        self._given = [drive.chosen for drive in drives]
        self._candidates = Candidates(effects, self._given)

    @cached_property
    def alone(self) -> tuple[DriveState, ...]:
        """The drives fitted beside the most probable effects without any process."""
        return self._alone()

    def explained(self) -> Explained:
        """The drives with what acts on them."""
        return self._explained(self._converged(self.alone, with_processes=True, with_stretches=True))

    def explained_above(self, least: float) -> Explained | None:
        """The same; None once it shows that its log posterior will not reach ``least``.

        What effects alone do not reach, processes may: those that reach it without effects are looked at beside them.
        """
        start = None
        with suppress(_OutOfReachError):
            start = self._alone(least)
        try:
            found = self._converged(start or self._drives, with_processes=True, with_stretches=True, least=least)
        except _OutOfReachError:
            return None
        if start is not None:
            return self._explained(found)
        return self.explained() if found.log_posterior > least else None

    def _explained(self, found: _Converged) -> Explained:
        first = ranked(self._drives, self._effects)
        return explained_by(found.joint, found.table, found.chosen, found.states, first, self._effects)

    def _alone(self, least: float = -np.inf) -> tuple[DriveState, ...]:
        """The drives beside effects alone, from the noise of the drives, and from the usual one where theirs is larger.

        Over a road that no signal shows, its stretches come before the effects or after them: either may hold the place
        of the other.

        Raises
        ------
        _OutOfReachError
            Neither would reach ``least``.
        """
        found = self._from(self._drives, least)
        if any(drive.has_unusual_noise for drive in self._drives):
            found += self._from(tuple(drive.with_usual_noise() for drive in self._drives), least)
        if not found:
            raise _OutOfReachError
        return max(found, key=lambda one: one[0])[1]

    def _from(self, start: tuple[DriveState, ...], least: float) -> list[tuple[float, tuple[DriveState, ...]]]:
        """What the search among effects alone comes to from one start: the drives, with the log posterior before them.

        Nothing where that will not reach ``least``. Tables are not kept: they have megabytes.
        """
        found = list[tuple[float, tuple[DriveState, ...]]]()
        with suppress(_OutOfReachError):
            found.append(self._converged(start, least=least).as_fitted)
            if any(drive.is_hidden for drive in start):
                found += [self._converged(first, with_stretches=True).as_fitted for first in (found[-1][1], start)]
        return found

    def _converged(
        self,
        states: tuple[DriveState, ...],
        with_processes: bool = False,
        with_stretches: bool = False,
        least: float = -np.inf,
    ) -> _Converged:
        """Tables and scales, each found beside the other while that gains.

        A set that is best with the scales found beside another one may have less evidence with its own, and sizes that
        are impossible for the vehicle as it is found then: the next table goes on from there without that set.

        Raises
        ------
        _OutOfReachError
            As many rounds as a set has causes, each with the gain of the last, would not reach ``least``.
        """
        found, last, value = None, None, log_evidence(states)
        for size in range(2, MAX_ROUNDS + 2):
            candidates = [
                self._candidates.on(number, state, with_processes, with_stretches)
                for number, state in enumerate(states)
            ]
            joint = Hypotheses(states, self._given, candidates)
            causes = joint.causes()
            before = joint.before() if with_processes else ()  # processes come to the effects found without them
            room = max(size, len(before) + 1)
            table = weigh(joint, causes, min(room, MAX_CAUSES), before)
            fitted = joint.fitted(table.best)
            if log_evidence(fitted) + MAX_CAUSES * max(log_evidence(fitted) - log_evidence(states), 0.0) < least:
                raise _OutOfReachError
            gain = log_evidence(fitted) + joint.log_prior(table.best, causes) - value
            if found is not None and gain < -ROUNDING:
                break
            last, states = _Converged(joint, table, table.best, fitted), fitted
            for number, term, magnitude in joint.rivals(table):
                self._candidates.rival(number, term, magnitude)
            if all(state.is_possible(len(given)) for state, given in zip(states, self._given, strict=True)):
                found, value = last, value + gain
                if len(table.best) < room and gain < MIN_ROUND_GAIN:
                    break
        found = found or last
        assert found is not None
        best = found.joint.worthwhile(found.chosen)
        return found if best == found.chosen else replace(found, chosen=best, states=found.joint.fitted(best))

"""Which components act: a table of models over effects and nameless processes, beside the scales of road and noise.

Noise whose scale was found without the effects is too large, and hides them. So the table is made in rounds: sets of
one cause more each time, with the scales of road and noise found again beside the most probable set, and times of
effects that switch proposed beside it.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from estimator.components.candidates import Candidates, FoundForms
from estimator.components.drive_state import DriveState
from estimator.components.explained import Explained, explained_by, log_evidence, ranked
from estimator.components.hypotheses import Hypotheses
from estimator.components.model_table import MAX_CAUSES, Chosen, ModelTable, weigh
from estimator.model.effects.effect import Effect

MAX_ROUNDS = 20  # of table and scales, each found beside the other
MIN_ROUND_GAIN = 1.0  # in log evidence, for one round more
ROUNDING = 1e-6  # of log evidence: by less, a round that finds the same set and scales again differs by rounding alone


@dataclass(frozen=True, kw_only=True)
class _Round:
    """A table of sets of up to ``room`` causes, the set chosen from it, and the drives fitted beside that set."""

    room: int
    joint: Hypotheses
    table: ModelTable
    chosen: Chosen
    states: tuple[DriveState, ...]

    @cached_property
    def log_posterior(self) -> float:
        """Log evidence of the set that was chosen, with its prior odds."""
        return log_evidence(self.states) + self.joint.log_prior(self.chosen, self.joint.causes())

    def expected(self, before: float) -> float:
        """The log evidence of as many rounds as a set has causes, each with the gain over ``before`` of this one."""
        value = log_evidence(self.states)
        return value + MAX_CAUSES * max(value - before, 0.0)

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
    forms
        That other searches on these drives found; those of this one are added.
    """

    def __init__(
        self, drives: tuple[DriveState, ...], effects: Sequence[Effect], forms: FoundForms | None = None
    ) -> None:
        self._drives, self._effects, self._forms = drives, effects, forms or FoundForms()
        self._given = [drive.chosen for drive in drives]
        self._candidates = Candidates(effects, self._given, self._forms)

    @cached_property
    def alone(self) -> tuple[DriveState, ...]:
        """The drives fitted beside the most probable effects without any process."""
        return self._alone()

    def explained(self) -> Explained:
        """The drives with what acts on them."""
        return self._explained(self._converged(self.alone, with_processes=True, with_stretches=True))

    def explained_above(self, least: float) -> Explained | None:
        """The same; None once it shows that its log posterior will not reach ``least``."""
        try:
            alone = self._alone(least)
            return self._explained(self._converged(alone, with_processes=True, with_stretches=True, least=least))
        except _OutOfReachError:
            return None

    def _explained(self, found: _Round) -> Explained:
        first = ranked(self._drives, self._effects)
        return explained_by(found.joint, found.table, found.chosen, found.states, first, self._effects)

    @property
    def _starts(self) -> Iterator[tuple[DriveState, ...]]:
        """The drives with their own noise, and with the usual one where theirs is larger."""
        yield self._drives
        if any(drive.has_unusual_noise for drive in self._drives):
            yield tuple(drive.with_usual_noise() for drive in self._drives)

    def _alone(self, least: float = -np.inf) -> tuple[DriveState, ...]:
        """The drives beside effects alone. Tables are not kept: they have megabytes.

        Over a road that no signal shows, its stretches come before the effects or after them: either may hold the place
        of the other.

        Raises
        ------
        _OutOfReachError
            No start would reach ``least``.
        """
        found = list[tuple[float, tuple[DriveState, ...]]]()
        for start in self._starts:
            with suppress(_OutOfReachError):
                found.append(self._converged(start, least=least).as_fitted)
                if any(drive.is_hidden for drive in start):
                    found += [self._converged(first, with_stretches=True).as_fitted for first in (found[-1][1], start)]
        if not found:
            raise _OutOfReachError
        return max(found, key=lambda one: one[0])[1]

    def _round(self, states: tuple[DriveState, ...], size: int, with_processes: bool, with_stretches: bool) -> _Round:
        """Sets of up to ``size`` causes, or one more than act already, beside the drives as they are."""
        candidates = [
            self._candidates.on(number, state, with_processes, with_stretches) for number, state in enumerate(states)
        ]
        joint = Hypotheses(states, self._given, candidates)
        known = joint.before() if with_processes else ()  # processes come to the effects found without them
        room = max(size, len(known) + 1)
        table = weigh(joint, joint.causes(), min(room, MAX_CAUSES), known)
        return _Round(room=room, joint=joint, table=table, chosen=table.best, states=joint.fitted(table.best))

    def _converged(
        self,
        states: tuple[DriveState, ...],
        with_processes: bool = False,
        with_stretches: bool = False,
        least: float = -np.inf,
    ) -> _Round:
        """Tables and scales, each found beside the other while that gains.

        A set that is best with the scales found beside another one may have less evidence with its own, and sizes that
        are impossible for the vehicle as it is found then: the next table goes on from there without that set.

        Raises
        ------
        _OutOfReachError
            As many rounds as a set has causes, each with the gain of the last, would not reach ``least``.
        """
        found, last, highest = None, None, log_evidence(states)
        value = highest
        for size in range(2, MAX_ROUNDS + 2):
            latest = self._round(states, size, with_processes, with_stretches)
            if latest.expected(log_evidence(states)) < least:
                raise _OutOfReachError
            before, value = value, latest.log_posterior
            if found is not None and value < highest - ROUNDING:
                break
            last, states = latest, latest.states
            for number, term, magnitude in latest.joint.rivals(latest.table):
                self._forms.shape(number, term, magnitude)
            if all(state.is_possible(len(given)) for state, given in zip(states, self._given, strict=True)):
                gain, found, highest = value - highest, latest, value
            else:  # a set that is impossible and stays so gains nothing
                gain = abs(value - before)
            if len(latest.chosen) < latest.room and gain < MIN_ROUND_GAIN:
                break
        found = found or last
        assert found is not None
        for number, state in enumerate(found.states):
            self._forms.add(number, state)
        best = found.joint.worthwhile(found.chosen)
        return found if best == found.chosen else replace(found, chosen=best, states=found.joint.fitted(best))

"""Table of models: hypotheses (sets of forms of causes) with their posterior probabilities.

The table grows by steps that add or remove one form, from sets within Occam's window of the best (Madigan & Raftery
1994). A nameless process that first replaces two effects is so removed once both are in the set. The best set also
exchanges forms, because the form with most evidence alone need not have most beside others. Steps begin at the empty
set, and at a set from an earlier table: two effects may have most evidence together, and little alone. Probabilities
are sums over the table.
"""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp

from estimator.signals import Floats

WINDOW = 9.0  # in log probability: from sets 8,000 times less probable than the best no step is made
BEAM = 12  # sets of one step from which the next is made: bounds the cost
MAX_CAUSES = 5  # in a set

Chosen = tuple[int, ...]


class Evidence(Protocol):
    """Interface for the evidence of sets of forms, which are given by their numbers."""

    def log_evidence(self, chosen: Sequence[int]) -> float:
        """Log evidence of one set, less the costs of its forms."""

    def with_each(self, chosen: Sequence[int], others: Sequence[int]) -> Floats:
        """Log evidence (c,) of the set with each of ``others`` added."""


@dataclass(frozen=True, kw_only=True)
class Cause:
    """Effect or nameless process that may act: numbers of its forms, and log prior odds that it acts.

    ``log_forms`` is the log of the number of forms that share these odds equally. Forms with a cost are not counted:
    their cost is their prior probability.
    """

    name: str
    is_named: bool
    forms: tuple[int, ...]
    log_odds: float
    log_forms: float

    @property
    def log_prior(self) -> float:
        """Log prior odds of each form against the absence of the cause, costs not counted."""
        return self.log_odds - self.log_forms


@dataclass(frozen=True)
class ModelTable:
    """Sets of forms and their posterior probabilities (m,), most probable first."""

    sets: tuple[Chosen, ...]
    probability: Floats
    log_odds: float  # of any cause against none

    @property
    def best(self) -> Chosen:
        """Most probable set."""
        return self.sets[0]

    @property
    def none(self) -> float:
        """Probability of the empty set."""
        return 1 - self.holding(self._having)

    @cached_property
    def _having(self) -> dict[int, NDArray[np.intp]]:
        """Numbers of the sets that contain each form."""
        numbers: dict[int, list[int]] = defaultdict(list)
        for number, chosen in enumerate(self.sets):
            for form in chosen:
                numbers[form].append(number)
        return {form: np.array(sets, dtype=np.intp) for form, sets in numbers.items()}

    def holding(self, forms: Iterable[int]) -> float:
        """Probability that any of ``forms`` acts."""
        held = np.zeros(len(self.sets), dtype=np.bool_)
        for form in self._having.keys() & set(forms):
            held[self._having[form]] = True
        return min(float(self.probability[held].sum()), 1.0)  # rounding may add to more

    def rival(self, forms: Sequence[int], others: Mapping[str, Sequence[int]]) -> tuple[str, float]:
        """Name of the one of ``others`` that most likely acts if ``forms`` do not, and probability that either acts.

        ``others`` are forms by name. The name is empty, with the probability of ``forms``, if none of them has a
        probability above 0.5 given that ``forms`` do not act.
        """
        alone = self.holding(forms)
        either = {name: self.holding([*forms, *other_forms]) for name, other_forms in others.items()}
        rival = max(either, key=lambda name: either[name], default="")
        return (rival, either[rival]) if rival and either[rival] - alone > (1 - alone) / 2 else ("", alone)


def weigh(
    likelihood: Evidence, causes: Sequence[Cause], max_causes: int = MAX_CAUSES, before: Chosen = ()
) -> ModelTable:
    """Make the table from steps from the empty set and the set ``before``, with at most ``max_causes`` in a set."""
    log = dict[Chosen, float]()
    for start in dict.fromkeys(((), before)):
        _grow(start, log, likelihood, causes, max_causes)
    order = sorted(log, key=lambda chosen: -log[chosen])
    values = np.array([log[chosen] for chosen in order])
    others = [log[chosen] for chosen in order if chosen]
    odds = float(logsumexp(others)) - log[()] if others else -np.inf
    return ModelTable(tuple(order), np.exp(values - logsumexp(values)), odds)


def _grow(
    start: Chosen, log: dict[Chosen, float], likelihood: Evidence, causes: Sequence[Cause], max_causes: int
) -> None:
    """Add ``start`` and the sets reached from it, with their log posterior up to a constant, to ``log``."""
    prior = {form: cause.log_prior for cause in causes for form in cause.forms}

    def probable(chosen: Chosen) -> float:
        return likelihood.log_evidence(chosen) + sum(prior[form] for form in chosen)

    frontier, log[start] = [start], probable(start)
    for _ in range(2 * max_causes):  # up to the largest sets, and down again
        reached: dict[Chosen, float] = {}
        for chosen in frontier:
            smaller = [tuple(form for form in chosen if form != gone) for gone in chosen]
            reached |= {subset: probable(subset) for subset in smaller if subset not in log and subset not in reached}
            for base in (chosen, *smaller) if chosen == frontier[0] else (chosen,):
                added = _addable(base, causes, max_causes)
                more = likelihood.with_each(base, added) + [prior[form] for form in added] if added else np.empty(0)
                values = more + sum(prior[form] for form in base)
                larger = [tuple(sorted((*base, form))) for form in added]
                reached |= dict(zip(larger, values.tolist(), strict=True))
        new = sorted(reached.keys() - log.keys(), key=lambda chosen: (-reached[chosen], chosen))
        log |= {chosen: reached[chosen] for chosen in new}
        least = max(log.values()) - WINDOW
        frontier = [chosen for chosen in new[:BEAM] if reached[chosen] > least]
        if not frontier:
            break


def _addable(chosen: Chosen, causes: Sequence[Cause], max_causes: int) -> list[int]:
    """Forms of the causes that a set lacks; none if it has ``max_causes``."""
    if len(chosen) >= max_causes:
        return []
    return [form for cause in causes if not set(chosen) & set(cause.forms) for form in cause.forms]

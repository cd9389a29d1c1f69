"""Compute the table of models: hypotheses, which are sets of terms, with their posterior probabilities.

The table grows by steps that add or remove one term, from sets within Occam's window of the best (Madigan & Raftery
1994). A nameless process that first replaces two effects is so removed once both are in the set. The best set also
exchanges terms, because the term with most evidence alone need not have most beside others. Steps begin at the empty
set, and at given ones: two effects may have most evidence together, and little alone. Probabilities are sums over the
table.
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
MAX_TERMS = 5  # in a hypothesis

Hypothesis = tuple[int, ...]  # numbers of the terms that act together


class Evidence(Protocol):
    """Interface for the evidence of hypotheses."""

    def log_evidence(self, chosen: Sequence[int]) -> float:
        """Log evidence of one hypothesis, less the costs of its terms."""

    def log_evidence_with(self, chosen: Sequence[int], added: Sequence[int]) -> Floats:
        """`log_evidence` (c,) of the hypothesis with each of ``added``, one at a time."""


@dataclass(frozen=True, kw_only=True)
class TermGroup:
    """Terms of one effect or nameless process, of which a hypothesis holds at most one, and log prior odds of any.

    ``terms`` are their numbers. ``log_count`` is the log of the number of terms that share the odds equally. Terms with
    a cost are not counted: their cost is their prior probability.
    """

    name: str
    is_named: bool
    terms: tuple[int, ...]
    log_odds: float
    log_count: float

    @property
    def log_prior(self) -> float:
        """Log prior odds of each term against the absence of all of them, costs not counted."""
        return self.log_odds - self.log_count


@dataclass(frozen=True)
class ModelTable:
    """Hypotheses and their posterior probabilities (m,), most probable first."""

    hypotheses: tuple[Hypothesis, ...]
    probability: Floats
    log_odds: float  # of any term against none

    @property
    def best(self) -> Hypothesis:
        """Most probable hypothesis."""
        return self.hypotheses[0]

    @property
    def probability_of_none(self) -> float:
        """Probability of the empty hypothesis."""
        return 1 - self.probability_of_any(self._numbers_with)

    @cached_property
    def _numbers_with(self) -> dict[int, NDArray[np.intp]]:
        """Numbers of the hypotheses that contain each term."""
        numbers: dict[int, list[int]] = defaultdict(list)
        for number, chosen in enumerate(self.hypotheses):
            for term in chosen:
                numbers[term].append(number)
        return {term: np.array(hypotheses, dtype=np.intp) for term, hypotheses in numbers.items()}

    def probability_of_any(self, terms: Iterable[int]) -> float:
        """Probability that any of ``terms`` acts."""
        held = np.zeros(len(self.hypotheses), dtype=np.bool_)
        for term in self._numbers_with.keys() & set(terms):
            held[self._numbers_with[term]] = True
        return min(float(self.probability[held].sum()), 1.0)  # rounding may add to more

    def rival(self, terms: Sequence[int], alternatives: Mapping[str, Sequence[int]]) -> tuple[str, float]:
        """Name of the alternative that most likely acts if ``terms`` do not, and probability that either acts.

        ``alternatives`` are terms by name. The name is empty, with the probability of ``terms``, if no alternative has
        a probability above 0.5 given that ``terms`` do not act.
        """
        alone = self.probability_of_any(terms)
        either = {name: self.probability_of_any([*terms, *numbers]) for name, numbers in alternatives.items()}
        rival = max(either, key=lambda name: either[name], default="")
        return (rival, either[rival]) if rival and either[rival] - alone > (1 - alone) / 2 else ("", alone)


def weigh(
    likelihood: Evidence, groups: Sequence[TermGroup], max_terms: int = MAX_TERMS, starts: Iterable[Hypothesis] = ()
) -> ModelTable:
    """Make the table by steps from the empty hypothesis and from ``starts``, with at most ``max_terms`` in each."""
    log = dict[Hypothesis, float]()
    for first in dict.fromkeys(((), *starts)):
        _grow(first, log, likelihood, groups, max_terms)
    order = sorted(log, key=lambda chosen: -log[chosen])
    values = np.array([log[chosen] for chosen in order])
    others = [log[chosen] for chosen in order if chosen]
    odds = float(logsumexp(others)) - log[()] if others else -np.inf
    return ModelTable(tuple(order), np.exp(values - logsumexp(values)), odds)


def _grow(
    start: Hypothesis, log: dict[Hypothesis, float], likelihood: Evidence, groups: Sequence[TermGroup], max_terms: int
) -> None:
    """Add ``start`` and the hypotheses reached from it to ``log``, with their log posterior up to a constant."""
    prior = {term: group.log_prior for group in groups for term in group.terms}

    def probable(chosen: Hypothesis) -> float:
        return likelihood.log_evidence(chosen) + sum(prior[term] for term in chosen)

    frontier, log[start] = [start], probable(start)
    for _ in range(2 * max_terms):  # up to the largest hypotheses, and down again
        reached: dict[Hypothesis, float] = {}
        for chosen in frontier:
            smaller = [tuple(term for term in chosen if term != gone) for gone in chosen]
            reached |= {subset: probable(subset) for subset in smaller if subset not in log and subset not in reached}
            for base in (chosen, *smaller) if chosen == frontier[0] else (chosen,):
                added = _addable(base, groups, max_terms)
                more = (
                    likelihood.log_evidence_with(base, added) + [prior[term] for term in added]
                    if added
                    else np.empty(0)
                )
                values = more + sum(prior[term] for term in base)
                larger = [tuple(sorted((*base, term))) for term in added]
                reached |= dict(zip(larger, values.tolist(), strict=True))
        new = sorted(reached.keys() - log.keys(), key=lambda chosen: (-reached[chosen], chosen))
        log |= {chosen: reached[chosen] for chosen in new}
        least = max(log.values()) - WINDOW
        frontier = [chosen for chosen in new[:BEAM] if reached[chosen] > least]
        if not frontier:
            break


def _addable(chosen: Hypothesis, groups: Sequence[TermGroup], max_terms: int) -> list[int]:
    """Terms of the groups that a hypothesis lacks; none if it has ``max_terms``."""
    if len(chosen) >= max_terms:
        return []
    return [term for group in groups if not set(chosen) & set(group.terms) for term in group.terms]

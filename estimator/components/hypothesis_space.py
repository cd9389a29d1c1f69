"""Compute the evidence of hypotheses, which are sets of candidate terms, over all drives of a vehicle.

An effect of the vehicle acts in all drives, so its evidence is summed. An event is specific to one drive.
"""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.components import stretches
from estimator.components.candidate_terms import CandidateTerm
from estimator.components.drive_state import DriveState
from estimator.components.model_table import Hypothesis, ModelTable, TermGroup
from estimator.components.term import Kind, Term
from estimator.estimation.mixture import between
from estimator.estimation.shapes import is_free
from estimator.model.effect_term import EffectTerm
from estimator.model.spans import Spans
from estimator.signals import Floats

ODDS_OF_EFFECTS = 0.37  # prior odds of all effects together: "no effect" is e times as probable
ODDS_OF_PROCESSES = 0.05  # prior odds of all nameless processes together
MIN_PROBABILITY = 1e-4  # of a hypothesis that widens the covariance of the base, or names a rival
MIN_GAIN, MIN_GAIN_TIMED = 0.001, 0.01  # over the log BF of the strongest effect: errors of its form give as much

Key = tuple[object, ...]
Moments = tuple[Floats, Floats]  # mean (b,), covariance (b, b)


@dataclass(frozen=True)
class OtherHypotheses:
    """Contribution of other hypotheses to the base coefficients: a shift (b,) and covariance (b, b)."""

    shift: Floats
    covariance: Floats


def _mixed(chosen: Moments, members: Sequence[Moments], weights: Floats) -> OtherHypotheses:
    """Moments of a mixture minus those of ``chosen`` (law of total variance)."""
    shift, spread = between(weights, np.array([mean - chosen[0] for mean, _ in members]))
    within = sum(w * (covariance - chosen[1]) for w, (_, covariance) in zip(weights.tolist(), members, strict=True))
    return OtherHypotheses(shift, spread + within)


class HypothesisSpace:
    """All candidate terms on ``drives``, and the evidence of hypotheses among them.

    Terms are numbered in the order of ``keys``. The term of one number may differ from drive to drive, as its prior
    depends on the vehicle's fit: ``by_drive`` holds it for each drive that it may act on.

    Parameters
    ----------
    drives
        Drives of one vehicle, with the scales of road and noise.
    given
        Terms in every hypothesis, for each drive; their magnitudes are not limited.
    candidates
        Further terms that may act, for each drive.
    """

    def __init__(
        self,
        drives: Sequence[DriveState],
        given: Sequence[tuple[Term, ...]],
        candidates: Sequence[Iterable[CandidateTerm]],
    ) -> None:
        self.drives, self.given = [drive.bare() for drive in drives], given
        terms: dict[Key, dict[int, Term]] = defaultdict(dict)
        for number, candidates_on_drive in enumerate(candidates):
            for candidate in candidates_on_drive:
                drive_number = number if candidate.is_event else None
                terms[candidate.term.name, drive_number, candidate.key][number] = candidate.term
        self.keys, self.by_drive = list(terms), list(terms.values())
        on_drives = [
            [term_by_drive[number] for term_by_drive in self.by_drive if number in term_by_drive]
            for number in range(len(drives))
        ]
        given_without_limits = [
            tuple(replace(term, max_size=np.inf, max_positive_size=np.inf) for term in terms) for terms in given
        ]
        terms_of_drives = zip(drives, given_without_limits, on_drives, strict=True)
        self._likelihoods = [
            drive.likelihood_of([*fixed, *free]).without_columns() for drive, fixed, free in terms_of_drives
        ]
        count = [len(start) for start in given]
        self._numbers: list[dict[int, int]] = []
        for term_by_drive in self.by_drive:
            self._numbers.append({number: count[number] for number in term_by_drive})
            for number in term_by_drive:
                count[number] += 1

    def fitted_hypothesis(self) -> Hypothesis:
        """Numbers of the terms, without given ones, that the scales of the drives were fitted with."""
        acting = [
            (*drive.chosen[len(given) :], *([] if drive.stretches is None else [drive.stretches]))
            for drive, given in zip(self.drives, self.given, strict=True)
        ]
        marks = [{(term.name, term.effect_term, term.spans) for term in terms} for terms in acting]
        is_chosen = (
            all((term.name, term.effect_term, term.spans) in marks[n] for n, term in term_by_drive.items())
            for term_by_drive in self.by_drive
        )
        return tuple(i for i, is_there in enumerate(is_chosen) if is_there)

    def with_times(self, chosen: Hypothesis, number: int, times: Mapping[str, Spans]) -> Hypothesis | None:
        """Hypothesis with other ``times`` of effects, by name, on the drive ``number``; None if one is no candidate.

        An effect without times is left out.
        """
        kept = [i for i in chosen if not (self.keys[i][0] in times and number in self.by_drive[i])]
        wanted = {(name, number, spans) for name, spans in times.items() if spans}
        changed = [i for i, key in enumerate(self.keys) if key in wanted]
        return tuple(sorted((*kept, *changed))) if len(changed) == len(wanted) else None

    def log_evidence(self, chosen: Sequence[int], check_limits: bool = True) -> float:
        """Log evidence of a hypothesis, less costs.

        With ``check_limits`` it is minus infinity if a magnitude is impossible, given terms excepted.
        """
        return sum(
            likelihood.log_evidence(self._numbers_on(chosen, n), check_limits)
            for n, likelihood in enumerate(self._likelihoods)
        )

    def log_evidence_with(self, chosen: Sequence[int], added: Sequence[int], check_limits: bool = True) -> Floats:
        """`log_evidence` (c,) of the hypothesis with each of ``added``, one at a time."""
        total = np.zeros(len(added))
        for n, likelihood in enumerate(self._likelihoods):
            present, acting = self._numbers_on(chosen, n), [k for k, i in enumerate(added) if n in self.by_drive[i]]
            evidence = np.full(
                len(added), likelihood.log_evidence(present, check_limits) if len(acting) < len(added) else 0.0
            )
            numbers = [self._numbers[added[k]][n] for k in acting]
            evidence[acting] = likelihood.log_evidence_with(present, numbers, check_limits)
            total += evidence
        return total

    def _numbers_on(self, chosen: Sequence[int], number: int) -> list[int]:
        """Numbers of the given terms and of a hypothesis' terms in the likelihood of one drive."""
        numbers = [self._numbers[i][number] for i in chosen if number in self._numbers[i]]
        return [*range(len(self.given[number])), *numbers]

    def other_hypotheses(self, table: ModelTable, chosen: Hypothesis) -> tuple[OtherHypotheses, ...]:
        """Contribution of hypotheses with other effects and processes to the base coefficients, for each drive.

        Other terms of the same effects and processes are left to the averaging of shapes in the fit.
        """
        likely = table.probability > MIN_PROBABILITY
        weights = table.probability[likely] / table.probability[likely].sum()
        hypotheses = [hypothesis for hypothesis, counts in zip(table.hypotheses, likely, strict=True) if counts]
        groups = {self.keys[i][:2] for i in chosen}
        hypotheses = [chosen if {self.keys[i][:2] for i in other} == groups else other for other in hypotheses]
        return tuple(
            _mixed(
                likelihood.base_posterior(self._numbers_on(chosen, n)),
                [likelihood.base_posterior(self._numbers_on(hypothesis, n)) for hypothesis in hypotheses],
                weights,
            )
            for n, likelihood in enumerate(self._likelihoods)
        )

    def rivals(self, table: ModelTable) -> Iterator[tuple[int, EffectTerm, float]]:
        """Effects with a free shape in probable hypotheses but not in the best: drive, term and magnitude.

        Each is taken from the most probable hypothesis that contains it.
        """
        names = {self.term(i).name for i in table.best}
        for hypothesis in (
            hypothesis for hypothesis, p in zip(table.hypotheses, table.probability, strict=True) if p > MIN_PROBABILITY
        ):
            new = [i for i in hypothesis if self.term(i).name not in names]
            names |= {self.term(i).name for i in new}
            for i in new:
                for number, term in self.by_drive[i].items():
                    if term.effect_term is not None and is_free(term.effect_term):
                        present = self._numbers_on(hypothesis, number)
                        yield (
                            number,
                            term.effect_term,
                            self._likelihoods[number].amplitude(present, self._numbers[i][number]),
                        )

    def term(self, i: int) -> Term:
        """Term ``i`` on the first drive that it may act on; on all drives it has this name and category."""
        return next(iter(self.by_drive[i].values()))

    def groups(self) -> list[TermGroup]:
        """Groups of the terms of one effect or process, with their prior odds."""
        numbers: dict[Key, list[int]] = defaultdict(list)
        for i, key in enumerate(self.keys):
            numbers[key[:2]].append(i)
        kinds = {key: self.kind(terms[0]) for key, terms in numbers.items()}
        count = Counter(kinds.values())
        log_odds = {
            Kind.EFFECT: np.log(ODDS_OF_EFFECTS / max(count[Kind.EFFECT], 1)),
            Kind.PROCESS: np.log(ODDS_OF_PROCESSES / max(count[Kind.PROCESS], 1)),
            Kind.ROAD: stretches.LOG_ODDS,
        }
        return [
            TermGroup(
                name=" ".join(map(str, key)),
                is_named=kinds[key] is Kind.EFFECT,
                terms=tuple(terms),
                log_odds=float(log_odds[kinds[key]]),
                log_count=float(np.log(max(sum(not self.term(i).is_timed for i in terms), 1))),
            )
            for key, terms in numbers.items()
        ]

    def log_prior(self, chosen: Hypothesis, groups: Sequence[TermGroup]) -> float:
        """Log prior odds of a hypothesis among ``groups`` against none, costs of its times included."""
        present = [(group.log_prior, i) for group in groups for i in group.terms if i in chosen]
        return sum(log_prior - self.term(i).cost for log_prior, i in present)

    def gain(self, chosen: Hypothesis, removed: Sequence[int]) -> float:
        """Log Bayes factor of the terms ``removed`` given the others of a hypothesis, less their costs."""
        without = [i for i in chosen if i not in removed]
        return self.log_evidence(chosen, check_limits=False) - self.log_evidence(without, check_limits=False)

    def without_small_gains(self, chosen: Hypothesis) -> Hypothesis:
        """Hypothesis without effects whose gain is within the error of form of the strongest effect."""
        gains = {i: self.gain(chosen, [i]) for i in chosen if self.kind(i) is Kind.EFFECT}
        most = max(gains.values(), default=0.0)
        small = {i for i in gains if gains[i] < most * (MIN_GAIN_TIMED if self.term(i).is_timed else MIN_GAIN)}
        return tuple(i for i in chosen if i not in small)

    def kind(self, i: int) -> Kind:
        """Category of term ``i`` in the answer."""
        return self.term(i).kind

    def _parts(self, chosen: Hypothesis, number: int, kind: Kind) -> tuple[Term, ...]:
        """Terms of one kind in a hypothesis, on the drive with this ``number``."""
        return tuple(self.by_drive[i][number] for i in chosen if self.kind(i) is kind and number in self.by_drive[i])

    def fitted(self, chosen: Hypothesis) -> tuple[DriveState, ...]:
        """Drives with the effects and stretches of a hypothesis, scales refitted with its processes too."""
        return tuple(
            drive.with_terms(
                (*given, *self._parts(chosen, n, Kind.EFFECT)),
                self._parts(chosen, n, Kind.PROCESS),
                next(iter(self._parts(chosen, n, Kind.ROAD)), None),
            )
            for n, (drive, given) in enumerate(zip(self.drives, self.given, strict=True))
        )

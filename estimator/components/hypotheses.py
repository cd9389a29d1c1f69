"""Hypotheses (sets of forms of candidates), and their evidence over all drives of a vehicle.

An effect of the vehicle acts in all drives, so its evidence is summed. An event is specific to one drive.
"""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from estimator.components import stretches
from estimator.components.candidates import Candidate
from estimator.components.drive_state import DriveState
from estimator.components.likelihood import JointLikelihood
from estimator.components.model_table import Cause, Chosen, ModelTable
from estimator.components.term import Kind, Term
from estimator.estimation.mixture import between
from estimator.estimation.shapes import is_free
from estimator.model.effect_term import EffectTerm
from estimator.signals import Floats

ODDS_OF_EFFECTS = 0.37  # prior odds of all effects together: "no effect" is e times as probable
ODDS_OF_PROCESSES = 0.05  # prior odds of all nameless processes together
MIN_PROBABILITY = 1e-4  # of a hypothesis that widens the covariance of the base, or names a rival
MIN_GAIN, MIN_GAIN_TIMED = 0.001, 0.01  # over the log BF of the strongest effect: errors of its form give as much

Key = tuple[object, ...]
Moments = tuple[Floats, Floats]  # mean (b,), covariance (b, b)


@dataclass(frozen=True)
class OtherSets:
    """Contribution of other hypotheses to the base coefficients: a shift (b,) and covariance (b, b)."""

    shift: Floats
    covariance: Floats


def _mixed(chosen: Moments, members: Sequence[Moments], weights: Floats) -> OtherSets:
    """Moments of a mixture minus those of ``chosen`` (law of total variance)."""
    shift, spread = between(weights, np.array([mean - chosen[0] for mean, _ in members]))
    within = sum(w * (covariance - chosen[1]) for w, (_, covariance) in zip(weights.tolist(), members, strict=True))
    return OtherSets(shift, spread + within)


class Hypotheses:
    """All candidates on ``drives``, each cause in all its forms, and the evidence of hypotheses (sets of forms).

    Forms are numbered in the order of ``keys``.

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
        candidates: Sequence[Iterable[Candidate]],
    ) -> None:
        self.drives, self.given = drives, given
        terms: dict[Key, dict[int, Term]] = defaultdict(dict)
        for number, own_candidates in enumerate(candidates):
            for candidate in own_candidates:
                terms[candidate.cause, number if candidate.is_event else None, candidate.form][number] = candidate.term
        self.keys, self.each = list(terms), list(terms.values())
        on_drives = [
            [by_drive[number] for by_drive in self.each if number in by_drive] for number in range(len(drives))
        ]
        unlimited = [
            tuple(replace(term, max_size=np.inf, max_positive_size=np.inf) for term in terms) for terms in given
        ]  # without limits of their sizes
        self._joints = [d.likelihood_of([*g, *c]) for d, g, c in zip(drives, unlimited, on_drives, strict=True)]
        count = [len(start) for start in given]
        self._places: list[dict[int, int]] = []
        for by_drive in self.each:
            self._places.append({number: count[number] for number in by_drive})
            for number in by_drive:
                count[number] += 1

    def before(self) -> Chosen:
        """Numbers of the forms, without given ones, that the scales of the drives were fitted with."""
        acting = [
            (*drive.chosen[len(given) :], *([] if drive.stretches is None else [drive.stretches]))
            for drive, given in zip(self.drives, self.given, strict=True)
        ]
        marks = [{(term.name, term.effect_term, term.spans) for term in terms} for terms in acting]
        is_chosen = (
            all((c.name, c.effect_term, c.spans) in marks[n] for n, c in by_drive.items()) for by_drive in self.each
        )
        return tuple(i for i, is_there in enumerate(is_chosen) if is_there)

    def log_evidence(self, chosen: Sequence[int]) -> float:
        """Log evidence of a hypothesis, less costs; minus infinity if a size is impossible, given terms excepted."""
        return sum(joint.log_evidence(self._numbers_on(chosen, n)) for n, joint in enumerate(self._joints))

    def unlimited(self, chosen: Sequence[int]) -> float:
        """Log evidence of a hypothesis, less costs, without limits of the sizes."""
        return sum(joint.unlimited(self._numbers_on(chosen, n)) for n, joint in enumerate(self._joints))

    def with_each(self, chosen: Sequence[int], others: Sequence[int]) -> Floats:
        """`log_evidence` (c,) of the hypothesis with each of ``others`` added."""
        return self._with_each(chosen, others, JointLikelihood.log_evidence, JointLikelihood.with_each)

    def unlimited_with_each(self, chosen: Sequence[int], others: Sequence[int]) -> Floats:
        """`unlimited` (c,) of the hypothesis with each of ``others`` added."""
        return self._with_each(chosen, others, JointLikelihood.unlimited, JointLikelihood.unlimited_with_each)

    def _with_each(
        self,
        chosen: Sequence[int],
        others: Sequence[int],
        alone: Callable[[JointLikelihood, Sequence[int]], float],
        with_each: Callable[[JointLikelihood, Sequence[int], Sequence[int]], Floats],
    ) -> Floats:
        """Sum (c,) over the drives of ``with_each``, or of ``alone`` on drives where the added form does not act."""
        total = np.zeros(len(others))
        for n, joint in enumerate(self._joints):
            here, acting = self._numbers_on(chosen, n), [k for k, i in enumerate(others) if n in self.each[i]]
            added = np.full(len(others), alone(joint, here) if len(acting) < len(others) else 0.0)
            added[acting] = with_each(joint, here, [self._places[others[k]][n] for k in acting])
            total += added
        return total

    def _numbers_on(self, chosen: Sequence[int], number: int) -> list[int]:
        """Numbers of the given terms and of a hypothesis' terms in the likelihood of one drive."""
        places = [self._places[i][number] for i in chosen if number in self._places[i]]
        return [*range(len(self.given[number])), *places]

    def others(self, table: ModelTable, chosen: Chosen) -> tuple[OtherSets, ...]:
        """Contribution of hypotheses with other causes to the base coefficients, for each drive.

        Other forms of the same causes are left to the averaging of shapes in the fit.
        """
        likely = table.probability > MIN_PROBABILITY
        weights = table.probability[likely] / table.probability[likely].sum()
        sets = [hypothesis for hypothesis, counts in zip(table.sets, likely, strict=True) if counts]
        causes = {self.keys[i][:2] for i in chosen}
        sets = [chosen if {self.keys[i][:2] for i in hypothesis} == causes else hypothesis for hypothesis in sets]
        return tuple(
            _mixed(
                joint.base(self._numbers_on(chosen, n)),
                [joint.base(self._numbers_on(hypothesis, n)) for hypothesis in sets],
                weights,
            )
            for n, joint in enumerate(self._joints)
        )

    def rivals(self, table: ModelTable) -> Iterator[tuple[int, EffectTerm, float]]:
        """Effects with a free shape in probable hypotheses but not in the best: drive, term and magnitude.

        Each is taken from the most probable hypothesis that contains it.
        """
        names = {self.term(i).name for i in table.best}
        for hypothesis in (
            hypothesis for hypothesis, p in zip(table.sets, table.probability, strict=True) if p > MIN_PROBABILITY
        ):
            new = [i for i in hypothesis if self.term(i).name not in names]
            names |= {self.term(i).name for i in new}
            for form in new:
                for number, term in self.each[form].items():
                    if term.effect_term is not None and is_free(term.effect_term):
                        here, column = self._numbers_on(hypothesis, number), self._places[form][number]
                        yield number, term.effect_term, self._joints[number].value(here, column)

    def term(self, i: int) -> Term:
        """One of the terms of form ``i``; all have the same name."""
        return next(iter(self.each[i].values()))

    def causes(self) -> list[Cause]:
        """Causes with their forms and prior odds."""
        grouped: dict[Key, list[int]] = defaultdict(list)
        for i, key in enumerate(self.keys):
            grouped[key[:2]].append(i)
        kinds = {cause: self.kind(forms[0]) for cause, forms in grouped.items()}
        number = Counter(kinds.values())
        log_odds = {
            Kind.EFFECT: np.log(ODDS_OF_EFFECTS / max(number[Kind.EFFECT], 1)),
            Kind.PROCESS: np.log(ODDS_OF_PROCESSES / max(number[Kind.PROCESS], 1)),
            Kind.ROAD: stretches.LOG_ODDS,
        }
        return [
            Cause(
                name=" ".join(map(str, cause)),
                is_named=kinds[cause] is Kind.EFFECT,
                forms=tuple(forms),
                log_odds=float(log_odds[kinds[cause]]),
                log_forms=float(np.log(max(sum(not self.term(i).is_timed for i in forms), 1))),
            )
            for cause, forms in grouped.items()
        ]

    def log_prior(self, chosen: Chosen, causes: Sequence[Cause]) -> float:
        """Log prior odds of a hypothesis among ``causes`` against none, costs of its times included."""
        present = [(cause.log_prior, form) for cause in causes for form in cause.forms if form in chosen]
        return sum(log_odds - self.term(form).cost for log_odds, form in present)

    def gain(self, chosen: Chosen, form: int) -> float:
        """Log Bayes factor of one form given the others of a hypothesis, less its cost."""
        return self.unlimited(chosen) - self.unlimited([i for i in chosen if i != form])

    def worthwhile(self, chosen: Chosen) -> Chosen:
        """Hypothesis without effects whose gain is within the error of form of the strongest effect."""
        gains = {i: self.gain(chosen, i) for i in chosen if self.kind(i) is Kind.EFFECT}
        most = max(gains.values(), default=0.0)
        small = {i for i in gains if gains[i] < most * (MIN_GAIN_TIMED if self.term(i).is_timed else MIN_GAIN)}
        return tuple(i for i in chosen if i not in small)

    def kind(self, i: int) -> Kind:
        """Category of form ``i`` in the answer."""
        return self.term(i).kind

    def _parts(self, chosen: Chosen, number: int, kind: Kind) -> tuple[Term, ...]:
        """Terms of one kind in a hypothesis, on the drive with this ``number``."""
        return tuple(self.each[i][number] for i in chosen if self.kind(i) is kind and number in self.each[i])

    def fitted(self, chosen: Chosen) -> tuple[DriveState, ...]:
        """Drives with the effects and stretches of a hypothesis, scales refitted with its processes too."""
        return tuple(
            drive.having(
                (*given, *self._parts(chosen, n, Kind.EFFECT)),
                self._parts(chosen, n, Kind.PROCESS),
                next(iter(self._parts(chosen, n, Kind.ROAD)), None),
            )
            for n, (drive, given) in enumerate(zip(self.drives, self.given, strict=True))
        )

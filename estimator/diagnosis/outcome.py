"""A finished search, and the quantities that its report is computed from."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from estimator.answers.diagnosis import Verdict
from estimator.diagnosis.held_out import HeldOut
from estimator.diagnosis.hidden_grade import hidden_grade
from estimator.diagnosis.multi_drive import Drive, Joint, is_same_class, pooled
from estimator.diagnosis.processes import FORCE_OVER_TIME, POWER_OVER_TIME, UNMEASURED_GRADE, Leftover
from estimator.diagnosis.search import Found, Search
from estimator.diagnosis.thresholds import Thresholds
from estimator.model.effects import Effect

MIN_FLOOR_SHARE = 0.05  # of the squared residual, that is always counted as noise
MAX_DOUBT = 0.5  # share of the noise floor that may be an effect instead


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """The result of a search from the ``plain`` models; ``rng`` is for the bootstrap."""

    result: Search
    plain: tuple[Drive, ...]
    effects: Sequence[Effect]
    rng: np.random.Generator
    thresholds: Thresholds

    @property
    def final(self) -> tuple[Drive, ...]:
        """The drives with all chosen effects."""
        return self.result.drives

    @cached_property
    def longest(self) -> int:
        """Number of the drive with most samples, which figures of a single drive are taken from."""
        return max(range(len(self.plain)), key=lambda i: len(self.plain[i].model.samples))

    @cached_property
    def grade(self) -> Leftover | None:
        """A grade that no signal shows."""
        return hidden_grade(self.result.ranking, self.result.at_first, self.plain, self.thresholds)

    @cached_property
    def steps(self) -> list[HeldOut]:
        """Held-out residuals before each chosen effect, and after the last, on the samples of the final model."""
        return [pooled(drives, self.final) for drives in (*(f.before for f in self.result.chosen), self.final)]

    @property
    def left(self) -> Leftover:
        """The process with most evidence in the residual of the final models."""
        return self.result.at_last[0]

    @property
    def doubt(self) -> float:
        """Share of the final squared residual that the best remaining process explains, at most MAX_DOUBT."""
        return min(self.left.variance / self.steps[-1].mean_square, MAX_DOUBT)

    @property
    def floor(self) -> float:
        """Mean squared residual [W^2] that counts as noise."""
        after = self.steps[-1].mean_square
        is_hidden = self.left.log_bayes_factor > self.thresholds.min_log_bf_left_process
        hidden = self.left.variance if is_hidden else 0.0
        return max(after - hidden, MIN_FLOOR_SHARE * after)

    @property
    def is_altimeter_error(self) -> bool:
        """Whether the residual may be the error of an altimeter in the model: it varies with place or time."""
        wanders = (UNMEASURED_GRADE, POWER_OVER_TIME, FORCE_OVER_TIME)
        altimeter = [other for other in self.result.at_last if other.name in wanders]
        least = self.left.log_bayes_factor - self.thresholds.min_log_bf_effect
        near = max(other.log_bayes_factor for other in altimeter) > least
        return near and any(term.effect.is_gravity for drive in self.final for term in drive.model.terms)

    @property
    def is_on_hills(self) -> bool:
        """Whether the road has grades: one is in the model by a signal, or missing in it."""
        shown = any(term.effect.is_gravity for drive in self.final for term in drive.model.terms)
        return shown or self.grade is not None

    def probability(self, found: Found) -> float:
        """Probability of a chosen effect, among all candidates and the process at that step."""
        rivals = [joint.log_bayes_factor for joint in found.ranking if joint is not found.joint]
        if not found.is_beside:
            rivals.append(found.joint.log_bayes_factor - found.margin)
        return self.thresholds.probabilities([found.joint.log_bayes_factor, *rivals])[0]

    @cached_property
    def verdict(self) -> Verdict:
        """The verdict by the evidence, without a lag."""
        chosen, left, limits = self.result.chosen, self.left.log_bayes_factor, self.thresholds
        if self.grade is not None or (chosen and self.is_altimeter_error):
            return Verdict.EFFECT
        if not chosen:
            if left > limits.min_log_bf_process and not self.is_altimeter_error:
                return Verdict.UNKNOWN
            best = self.result.ranking[0].log_bayes_factor if self.result.ranking else 0.0
            return Verdict.CANNOT_TELL if best > limits.max_log_bf_no_gap else Verdict.NO_GAP
        at_first = self.result.at_first[0].log_bayes_factor
        total = sum(found.joint.log_bayes_factor for found in chosen)
        outdone = total < at_first + limits.min_log_bf_lead or left > limits.max_left_share * max(at_first, total)
        if total < at_first or (left > limits.min_log_bf_left_process and outdone):
            return Verdict.UNKNOWN if max(at_first, left) > limits.min_log_bf_process else Verdict.CANNOT_TELL
        improbable = self.probability(chosen[0]) < limits.min_probability
        return Verdict.CANNOT_TELL if improbable or ties(chosen[0], limits) else Verdict.EFFECT


def _rivals(found: Found, thresholds: Thresholds) -> list[Joint]:
    """Effects whose evidence is within ``min_log_bf_lead`` of that of the chosen one."""
    limit = found.joint.log_bayes_factor - thresholds.min_log_bf_lead
    return [joint for joint in found.ranking if joint is not found.joint and joint.log_bayes_factor > limit]


def ties(found: Found, thresholds: Thresholds) -> list[str]:
    """Names of rivals of the chosen effect that are of another class: a different drive can separate them."""
    return [joint.name for joint in _rivals(found, thresholds) if not is_same_class(found.joint, joint, thresholds)]


def alike(found: Found, thresholds: Thresholds) -> list[str]:
    """Names of the same class that have enough evidence as well, and those declared equivalent."""
    least = thresholds.min_log_bf_effect
    others = (joint for joint in found.ranking if joint is not found.joint and joint.log_bayes_factor > least)
    near = {joint.name for joint in others if is_same_class(found.joint, joint, thresholds)}
    return sorted(near | set(found.joint.effect.equivalent))

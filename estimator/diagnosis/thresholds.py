"""Thresholds of the diagnosis, and probabilities from evidence.

Evidence is a natural logarithm of a Bayes factor (log BF). The defaults were chosen on 240 simulated drives of another
seed than those of the blind check (docs/blind_check.md); docs/how_it_decides.md says where each is used.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import logsumexp


@dataclass(frozen=True, kw_only=True)
class Thresholds:
    """Limits by which effects are named; a test or a sweep gives its own to `diagnose`.

    A timed effect is one whose switching times are fitted. Free times also fit errors of the effects already in the
    model, so it needs more evidence.
    """

    max_log_bf_no_gap: float = 3.0  # of the best effect, where the verdict is "no gap"
    min_log_bf_effect: float = 5.0  # of the first effect, any beside the road, a lag, a rival; of signals of the road
    min_log_bf_timed: float = 11.0  # of the first effect, if it is timed
    min_log_bf_further: float = 8.0  # of an effect beside others
    min_log_bf_further_timed: float = 20.0  # of a timed effect beside others
    min_log_bf_lead: float = 3.0  # of an effect over the next one of another class
    min_log_bf_process: float = 15.0  # of a process: an unknown effect acts
    min_log_bf_left_process: float = 20.0  # of a process in the residual of a model that has effects
    min_probability: float = 0.5  # of an effect that is named alone
    max_left_share: float = 0.25  # of the processes' evidence that may remain beside the effects named for it
    min_class_correlation: float = 0.95  # |correlation| of traces above which two effects are one class
    min_reduction: float = 0.001  # of the squared residual, over the largest reduction by another effect
    min_reduction_timed: float = 0.01  # the same for a timed effect
    min_grade_log_bf_share: float = 0.5  # of a hidden grade's log BF over that of the best process
    min_grade_sd: float = 0.002  # of hills [1]: level ones without other effects come out at 0.0001 .. 0.0009
    min_lift_deficit_sd: float = 2.0  # sd by which the mass lifted with a signal of the climb is below the vehicle's
    min_expected_log_bf: float = 5.0  # of an effect of usual size: the drive would show it
    log_bf_temper: float = 1.5  # divisor of log BF in probabilities: the model of the noise is never exact
    log_prior_odds_none: float = 1.0  # of no effect against all effects together
    unmodelled_probability: float = 0.03  # kept for causes that no model here has

    def min_log_bf(self, is_timed: bool, others: int) -> float:
        """Log Bayes factor that adds an effect beside ``others`` effects."""
        if is_timed:
            return self.min_log_bf_further_timed if others else self.min_log_bf_timed
        return self.min_log_bf_further if others else self.min_log_bf_effect

    @property
    def min_log_bf_beside_road(self) -> dict[bool, float]:
        """Log Bayes factor that names an effect beside the road as a state, by whether it is timed."""
        return {False: self.min_log_bf_effect, True: self.min_log_bf_further_timed}

    def probabilities(self, log_bayes_factors: Sequence[float]) -> list[float]:
        """Probability of each effect, and last that of no effect; together 1 less ``unmodelled_probability``."""
        prior = np.log(len(log_bayes_factors)) + self.log_prior_odds_none
        tempered = [*(value / self.log_bf_temper - prior for value in log_bayes_factors), 0.0]
        share = 1 - self.unmodelled_probability
        return [share * float(np.exp(value - logsumexp(tempered))) for value in tempered]

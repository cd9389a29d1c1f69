"""How much evidence it takes: natural logarithms of Bayes factors."""

from collections.abc import Sequence

import numpy as np
from scipy.special import logsumexp

SOMETHING = 3.0  # below this there is no gap to speak of
NAMED = 5.0  # over none, names an effect
NAMED_TIMED = 11.0  # and if its times are free
AHEAD = 3.0  # over the next that is not of its class
NEXT = 8.0  # of an effect beside another: each one more has to earn its place
NEXT_TIMED = 20.0  # and if its times are free, it fits what the others left not quite right
EVIDENT = 15.0  # of a process, says that something is there, though nothing has a name
UNEXPLAINED = 20.0  # of a process, on what is left beside effects that have one
TEMPER = 1.5
RARE = 1.0  # log prior odds of none against any
LAPSE = 0.03


def probabilities(log_bayes_factors: Sequence[float]) -> list[float]:
    """Of each, and last of none.

    None is likelier beforehand than all others together. Evidence is tempered, for it is never as sharp as the model
    of the noise says; and LAPSE is kept back for what no model here foresees.
    """
    rare = np.log(len(log_bayes_factors)) + RARE
    tempered = [*(value / TEMPER - rare for value in log_bayes_factors), 0.0]
    return [(1 - LAPSE) * float(np.exp(value - logsumexp(tempered))) for value in tempered]

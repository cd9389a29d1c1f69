"""Comparison of the beliefs of the configuration with the fit of the drive alone."""

import numpy as np

from estimator.estimation.gate import Judged
from estimator.settings import Prior

MAX_BELIEF_SDS = 5.0  # largest difference of a belief and the drive, over the sd of the difference


def contradiction(prior: Prior, drive: Judged) -> str:
    """Message of the largest contradiction between the drive alone and a belief; empty if there is none."""
    beliefs = {"A": prior.A_belief_N, "C": prior.C_belief_N_s2_m2, "mass": prior.mass_belief_kg}
    worst, found = MAX_BELIEF_SDS, ""
    for i, (name, belief) in enumerate(beliefs.items()):
        if belief is not None:
            value, sd = float(drive.theta[i]), float(drive.sd[i])
            distance = abs(value - belief[0]) / float(np.hypot(sd, belief[1]))
            if distance > worst:
                worst = distance
                found = f"the drive says {name} {value:.4g} +- {sd:.2g}, the configuration believes {belief[0]:.4g}"
    return found

"""Gaussian prior of A, C and m, from sources other than the drive: a weigh ticket, a data sheet, an earlier load."""

from dataclasses import dataclass

import numpy as np

from estimator.settings import Prior
from estimator.signals import Floats

PARAMETERS = 3  # A [N], C [N s^2/m^2], m [kg]


@dataclass(frozen=True)
class Belief:
    """Gaussian of [A, C, m] in information form: ``precision`` (3, 3) and ``moment`` (3,) = precision @ mean.

    The sum of two beliefs combines independent sources.
    """

    precision: Floats
    moment: Floats

    def __add__(self, other: "Belief") -> "Belief":
        return Belief(self.precision + other.precision, self.moment + other.moment)

    @classmethod
    def none(cls) -> "Belief":
        """Return the belief without information: zero precision."""
        return cls(np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS))

    @classmethod
    def about(cls, i: int, mean: float, sd: float) -> "Belief":
        """Return the belief that parameter ``i`` has this ``mean`` and standard deviation ``sd``."""
        unit = np.eye(PARAMETERS)[i]
        return cls(np.outer(unit, unit) / sd**2, unit * mean / sd**2)

    @classmethod
    def configured(cls, prior: Prior) -> "Belief":
        """Return the sum of the beliefs in a configuration."""
        belief = cls.none()
        for i, mean_and_sd in enumerate((prior.A_belief_N, prior.C_belief_N_s2_m2, prior.mass_belief_kg)):
            if mean_and_sd is not None:
                belief = belief + cls.about(i, *mean_and_sd)
        return belief

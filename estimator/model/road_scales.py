"""Scales of the road and of the noise of all signals, with their priors."""

from dataclasses import dataclass

import numpy as np

from estimator.signals import Floats
from estimator.strides import Strides


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Scale of the noise or of the road: lognormal prior of median ``centre`` and log sd ``spread``, and bounds."""

    name: str
    centre: float
    spread: float
    low: float
    high: float


@dataclass(frozen=True)
class OperatingPoint:
    """Point that noise of the force has its scales at.

    Noise of the torque has its scale at the ``gearing`` [rad/m], noise of the power at the ``speed`` [m/s]. ``turns``
    [rad/s] stand in for engine speeds that are not known.
    """

    turns: float
    gearing: float
    speed: float

    @classmethod
    def of(cls, driven: Strides) -> "OperatingPoint":
        """Medians of strides with a known force; where no engine speed is known, gearings are of 1 rad/s."""
        turns = driven.usual_turns
        return cls(turns, float(np.median(driven.filled_gearing(turns))), float(np.median(driven.speed)))

    def shares(self, driven: Strides) -> Floats:
        """Factors (2, n) of the noises of torque and power in the acceleration of strides with a known force."""
        return np.array([driven.filled_gearing(self.turns) / self.gearing, self.speed / driven.speed])


# Centres and spreads are those of ordinary roads and sensors; drives of an hour override them.
SCALES = (
    Scale(name="torque noise", centre=5e-3, spread=1.0, low=1e-4, high=1.0),  # m/s^2, at the point's gearing
    Scale(name="torque noise time", centre=0.5, spread=0.5, low=0.05, high=5.0),  # s
    Scale(name="speed noise", centre=4e-3, spread=1.0, low=2e-4, high=0.2),  # m/s, of the mean over EDGE rows
    Scale(name="disturbance", centre=5e-4, spread=0.5, low=1e-4, high=0.2),  # m/s^2, of what no signal shows
    Scale(name="slope", centre=8e-3, spread=1.2, low=1e-4, high=0.08),  # sine
    Scale(name="slope length", centre=400.0, spread=0.6, low=60.0, high=3000.0),  # m
    Scale(name="power noise", centre=2e-3, spread=1.2, low=1e-4, high=1.0),  # m/s^2, at the point's speed
    Scale(name="power noise time", centre=0.5, spread=0.5, low=0.05, high=5.0),  # s
)
TORQUE, SPEED, DISTURBANCE, SLOPE, LENGTH, POWER = 0, 2, 3, 4, 5, 6  # places; times follow those of torque and power
SIGNAL_SCALES = {
    "altitude": (
        Scale(name="altitude noise", centre=0.3, spread=1.0, low=0.02, high=50.0),  # m
        Scale(name="altitude wander", centre=2.0, spread=1.2, low=0.05, high=300.0),  # m
        Scale(name="altitude wander time", centre=60.0, spread=1.0, low=5.0, high=3000.0),  # s
    ),
    "grade": (
        Scale(name="grade noise", centre=5e-3, spread=1.2, low=1e-4, high=0.3),  # sine
        Scale(name="grade wander", centre=5e-3, spread=1.2, low=1e-4, high=0.3),  # sine
        Scale(name="grade wander time", centre=60.0, spread=1.0, low=5.0, high=3000.0),  # s
    ),
    "gravity": (
        Scale(name="gravity noise", centre=5e-3, spread=1.2, low=1e-4, high=0.3),  # sine
        Scale(name="gravity wander", centre=5e-3, spread=1.2, low=1e-4, high=0.3),  # sine
        Scale(name="gravity wander time", centre=60.0, spread=1.0, low=5.0, high=3000.0),  # s
    ),
}

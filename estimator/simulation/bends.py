"""Curvature along a road: sharp in slow bends, elsewhere as small as the speed demands."""

from dataclasses import dataclass

import numpy as np

from estimator.signals import Floats
from estimator.simulation.noise import smooth

CURVE_SPACING = 5.0  # m between points of the curvature profile
WINDING = 0.4  # m/s^2, sd of the lateral acceleration outside bends
WINDING_LENGTH = 200.0  # m over which a road winds
MAX_LATERAL_ACCELERATION = 1.7  # m/s^2, lateral acceleration that no bend exceeds at its speed


@dataclass(frozen=True, slots=True)
class Bend:
    """Bend from ``start`` to ``end`` [m], driven at ``speed`` [m/s], with an ``angle`` within a range [rad]."""

    start: float
    end: float
    speed: float
    angle: tuple[float, float]


def curvature_of(start: Floats, speed: Floats, bends: list[Bend], length: float, rng: np.random.Generator) -> Floats:
    """Curvature [1/m], positive to the left, every ``CURVE_SPACING``.

    Parameters
    ----------
    start, speed
        Beginnings [m] and speeds [m/s] of the road's sections (k,).
    bends
        Slow bends.
    length
        Length of the road [m].
    rng
        Source of randomness.
    """
    distance = CURVE_SPACING * np.arange(int(length / CURVE_SPACING) + 2)
    quick = np.maximum(speed[np.searchsorted(start, distance, side="right") - 1], 8.0)
    winding = smooth(len(distance), WINDING, WINDING_LENGTH / CURVE_SPACING / 2, rng)
    curvature: Floats = winding / quick**2
    for bend in bends:
        angle = rng.choice([-1.0, 1.0]) * rng.uniform(*bend.angle)
        sharpness = angle / (bend.end - bend.start)
        limit = MAX_LATERAL_ACCELERATION / bend.speed**2
        curvature[(distance >= bend.start) & (distance < bend.end)] = np.clip(sharpness, -limit, limit)
    return curvature

"""Road-load model: power at the wheels from speed and acceleration.

    P = A v + C v^3 + m v a,   and 0 where that is negative

v speed [m/s], a acceleration [m/s^2], P power [W]; parameters theta = [A, C, m]:
A rolling and friction force [N], C aerodynamic coefficient [N s^2/m^2], m mass [kg].

Source: Miller, Konan, Duran, "Bayesian Parameter Estimation for Heavy-Duty Vehicles", NREL.
"""

import numpy as np

from estimator.signals import Floats

NEW_LOAD_SD = 0.5  # sd of a new load's mass, as a share of the one before: empty to full doubles a truck's weight


def design(v: Floats, a: Floats, density: Floats | float = 1.0) -> Floats:
    """Columns v, v^3, v a (n, 3) of the model before the clip: ``P = design(v, a) @ [A, C, m]``.

    Drag is proportional to the density of the air: ``density`` is relative to that for which C holds.
    """
    return np.column_stack([v, density * v**3, v * a])


def power(v: Floats, a: Floats, theta: Floats) -> Floats:
    """Model power [W] (n,) for ``theta`` = [A, C, m], never negative."""
    return np.maximum(design(v, a) @ theta, 0.0)

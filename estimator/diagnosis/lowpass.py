"""A lag from a low-pass instead of a delay: the residual that remains after the alignment has shifted the signals.

A speed behind a first-order low-pass of time T is late by T. After a shift by T, m v T^2 / 2 d2a/dt2 remains.
"""

import numpy as np

from estimator.diagnosis.drive_data import Record
from estimator.diagnosis.evidence import Base, fit_base
from estimator.diagnosis.model import Model
from estimator.model.design_matrix import MASS, PLAIN
from estimator.preparation.smoothing import DERIVATIVE, convolve
from estimator.samples import STEP

LATE, EARLY = 0.5, -1.0  # factor of T^2 for power behind or before speed; before, delays of power cancel some of T


def as_filtered(record: Record, model: Model) -> Base | None:
    """The fit for a lag that comes from a low-pass alone; None where it cannot be fitted."""
    s, base = model.samples, model.base
    lag = record.lag + float(base.theta[PLAIN - 1])
    curvature = np.convolve(DERIVATIVE, DERIVATIVE) / STEP**2
    change = convolve(convolve(record.speed, record.smoother.slope), curvature)[record.at(s)]
    left = (LATE if lag > 0 else EARLY) * lag**2 * float(base.theta[MASS]) * s.v * change
    return fit_base(base.X, base.Z, base.P - left, base.block)

"""A lag that is not a delay but a low-pass: what it leaves once the alignment has shifted the signals.

A speed that is read through a first-order low-pass of time T comes late by T, and m v T^2 / 2 d2a/dt2 is left over.
"""

import numpy as np

from estimator.diagnosis.drive_data import Record
from estimator.diagnosis.evidence import Base, fit_base
from estimator.diagnosis.model import Model
from estimator.model.design_matrix import MASS, PLAIN
from estimator.preparation.smoothing import DERIVATIVE, convolve
from estimator.samples import STEP

LATE, EARLY = 0.5, -1.0  # of T^2; where power is early, its own delay hides some of the low-pass


def as_filtered(record: Record, model: Model) -> Base | None:
    """The fit if the lag found were all a low-pass; None where it cannot be."""
    s, base = model.samples, model.base
    lag = record.lag + float(base.theta[PLAIN - 1])
    curvature = np.convolve(DERIVATIVE, DERIVATIVE) / STEP**2
    change = convolve(convolve(record.speed, record.smoother.slope), curvature)[record.at(s)]
    left = (LATE if lag > 0 else EARLY) * lag**2 * float(base.theta[MASS]) * s.v * change
    return fit_base(base.X, base.Z, base.P - left, base.block)

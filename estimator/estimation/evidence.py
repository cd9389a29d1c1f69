"""Data and posterior draws of an estimate, for plots and files."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.estimation.posterior import Posterior
from estimator.estimation.road_fit import RoadFit
from estimator.estimation.window import Grid
from estimator.samples import over_mean
from estimator.signals import Floats


@dataclass(frozen=True, kw_only=True)
class Trace:
    """Data that the model was fitted to; all arrays (n,).

    ``t`` [s], ``v`` [m/s], ``a`` [m/s^2], ``P`` measured power [W] aligned with the speed, ``fitted`` power [W],
    ``density`` of the air [kg/m^3], NaN where unknown; ``spacing`` [s] is the time between consecutive elements.
    """

    t: Floats
    v: Floats
    a: Floats
    P: Floats
    fitted: Floats
    density: Floats
    spacing: float

    @property
    def relative_density(self) -> Floats:
        """Air density (n,) over its mean in this trace [1]; 1 where it is unknown."""
        return over_mean(self.density)

    @property
    def mean_density(self) -> float | None:
        """Mean density [kg/m^3] of the air, for which C holds; None where it is unknown."""
        known = self.density[np.isfinite(self.density)]
        return float(known.mean()) if len(known) else None


@dataclass(frozen=True)
class Coefficients:
    """Likelihood of [1/m, A/m, C/m] [1/kg, m/s^2, 1/m] as a Gaussian: ``mean`` (3,) and ``covariance`` (3, 3)."""

    mean: Floats
    covariance: Floats


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """Trace, draws, lag of power behind speed [s], rows per cell of the grid, residual [W], independent residuals.

    ``coefficients`` is the likelihood of the drive without beliefs and box, and ``fit`` the fit that gave it; both
    None by the paper's method.
    """

    trace: Trace
    posterior: Posterior
    lag: float
    grid: Grid
    counts: NDArray[np.int64]
    rms: float
    effective: float
    coefficients: Coefficients | None = None
    fit: RoadFit | None = None

"""A lag between power and speed beyond the usual delays of sensors; the alignment has removed it from the samples."""

from dataclasses import dataclass, replace

import numpy as np

from estimator.diagnosis.evidence import parameter_sd
from estimator.diagnosis.held_out import HeldOut, held_out
from estimator.diagnosis.multi_drive import Drive
from estimator.diagnosis.thresholds import Thresholds
from estimator.model.design_matrix import PLAIN
from estimator.samples import Samples

USUAL_LAG = (-0.06, 0.12)  # s, of power behind speed: control units send torque later than speed
MIN_EXCESS_SDS = 4.0  # sd of the lag by which it must lie outside USUAL_LAG
RESIDUALS_PER_INDEPENDENT = 4.0  # autocorrelated residuals of 2 s that weigh as one independent residual


@dataclass(frozen=True, kw_only=True)
class ExcessLag:
    """Lag [s] of power behind speed and its sd, the samples without alignment, residuals before and after alignment."""

    lag: float
    sd: float
    unaligned: Samples
    before: HeldOut
    after: HeldOut

    @property
    def log_bayes_factor(self) -> float:
        """Of the lag against none."""
        shrinkage = self.before.mean_square / self.after.mean_square
        return len(self.before.squares) / 2 * float(np.log(shrinkage)) / RESIDUALS_PER_INDEPENDENT

    @property
    def taken(self) -> float:
        """Reduction of the mean squared residual by the alignment [W^2]."""
        return self.before.mean_square - self.after.mean_square


def excess_lag(drive: Drive, thresholds: Thresholds) -> ExcessLag | None:
    """The lag of a drive; None where it is within USUAL_LAG, or where the alignment does not improve the fit."""
    model, s = drive.model, drive.model.samples
    lag = drive.record.lag + float(model.base.theta[PLAIN - 1])
    sd = parameter_sd(model.base, PLAIN - 1)
    if max(lag - USUAL_LAG[1], USUAL_LAG[0] - lag) < MIN_EXCESS_SDS * sd:
        return None
    # Power ``lag`` seconds earlier, to first order; the model has no column for its rate.
    unaligned = replace(s, P=s.P - lag * s.dP)
    before = held_out(unaligned, model.terms, model.road_load, lagged=False)
    late = ExcessLag(
        lag=lag, sd=sd, unaligned=unaligned, before=before, after=held_out(s, model.terms, model.road_load)
    )
    return late if late.log_bayes_factor >= thresholds.min_log_bf_effect else None

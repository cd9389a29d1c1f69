"""Power that reaches the bus later than speed does, or earlier, beyond what is ordinary; the alignment takes it out."""

from dataclasses import dataclass, replace

import numpy as np

from estimator.diagnosis.evidence import parameter_sd
from estimator.diagnosis.held_out import HeldOut, held_out
from estimator.diagnosis.multi_drive import Drive
from estimator.diagnosis.thresholds import Thresholds
from estimator.model.design_matrix import PLAIN
from estimator.samples import Samples

ORDINARY = (-0.06, 0.12)  # s, of power behind speed: torque takes longer to the bus
SURE = 4.0  # sd beyond it
CORRELATED = 4.0  # residuals of 2 s that count as one


@dataclass(frozen=True, kw_only=True)
class Lateness:
    """Lag [s] of power behind speed with its sd, samples as if nobody had aligned, residuals so and aligned."""

    lag: float
    sd: float
    unaligned: Samples
    before: HeldOut
    after: HeldOut

    @property
    def log_bayes_factor(self) -> float:
        """Of the lag against none."""
        shrinkage = self.before.mean_square / self.after.mean_square
        return len(self.before.squares) / 2 * float(np.log(shrinkage)) / CORRELATED

    @property
    def taken(self) -> float:
        """What the alignment takes away [W^2]."""
        return self.before.mean_square - self.after.mean_square


def lateness(drive: Drive, thresholds: Thresholds) -> Lateness | None:
    """The lag of a drive, if no sensor's ordinary delay explains it and the model is worse without."""
    model, s = drive.model, drive.model.samples
    lag = drive.record.lag + float(model.base.theta[PLAIN - 1])
    sd = parameter_sd(model.base, PLAIN - 1)
    if max(lag - ORDINARY[1], ORDINARY[0] - lag) < SURE * sd:
        return None
    # The power of lag seconds ago, to first order, and no column for its rate.
    unaligned = replace(s, P=s.P - lag * s.dP)
    before = held_out(unaligned, model.terms, model.road_load, lagged=False)
    late = Lateness(lag=lag, sd=sd, unaligned=unaligned, before=before, after=held_out(s, model.terms, model.road_load))
    return late if late.log_bayes_factor >= thresholds.min_log_bf_effect else None

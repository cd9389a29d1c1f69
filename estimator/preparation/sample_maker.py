"""From rows to admitted samples: lag, smoother, kinematics, admission, for a live bus, a whole log and a diagnosis."""

from collections import Counter
from collections.abc import Set

from estimator.preparation import kinematics, smoothing
from estimator.preparation.admission import admit, row_reasons
from estimator.preparation.lag import fit_lag
from estimator.samples import STEP, Rows, Samples
from estimator.settings import Admission, Kinematics
from estimator.signals import Floats, Quantity


class SampleMaker:
    """Makes samples of rows, and admits those that the model may be fitted to.

    Attributes
    ----------
    margin : int
        Rows that a sample needs on either side, for its instruments and for the distance to excluded moments.
    """

    def __init__(self, settings: Kinematics, admission: Admission) -> None:
        self._settings, self._admission = settings, admission
        self.margin = max(kinematics.margin(STEP), round(admission.margin_s / STEP))

    def calibrate(self, speed: Floats, power: Floats) -> tuple[smoothing.Kernels, float]:
        """Smoother of the noise found, and lag of power behind speed [s].

        Parameters
        ----------
        speed, power
            Plausible speed [m/s] and power [W] (n,) on the grid, NaN where not known.
        """
        lag = fit_lag(speed, power, STEP, self._settings.maximum_lag_s)
        return smoothing.smoother_kernels(smoothing.fit_ratio(speed, STEP), STEP), lag

    def core(self, rows: Rows) -> Rows:
        """The rows that have the margin on either side."""
        return rows[self.margin : len(rows) - self.margin]

    def samples(
        self, rows: Rows, smoother: smoothing.Kernels, lag: float, wanted: Set[Quantity], start: float
    ) -> Samples:
        """Samples of `core`, with the ``wanted`` context; time elapsed counts from ``start`` [s]."""
        spare = self.margin - kinematics.margin(STEP)
        inertial = self._settings.acceleration == "inertial"
        part = rows[spare : len(rows) - spare]
        return kinematics.to_samples(part, smoother, lag, inertial, wanted, start)

    def admit(self, samples: Samples, rows: Rows, rejected: Counter[str]) -> Samples:
        """Those ``samples`` of ``rows`` that may be fitted to; the others are counted by reason."""
        codes = row_reasons(rows, self._admission)[self.margin : len(rows) - self.margin]
        return admit(samples, codes, rejected)

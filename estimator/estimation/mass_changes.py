"""Whether the mass of a window changed: its parts before and after a cut are fitted by themselves and compared."""

from dataclasses import dataclass

import numpy as np

from estimator.estimation.road_fit import RoadFit, fit_given
from estimator.strides import Strides

PARTS = 4  # of the window, between which the mass may have changed
MIN_MASS_CHANGE_SDS = 4.0  # difference of two masses, in its sd: Gaussian noise exceeds it in 6e-5 of comparisons
MIN_MASS_CHANGE_SHARE = 0.04  # difference of the masses, as a share: smaller ones may come from the form of the model


@dataclass(frozen=True)
class Change:
    """Estimates of 1/m [1/kg] from the parts of a window before and after a cut, each with its variance."""

    before: float
    after: float
    variance_before: float
    variance_after: float

    @property
    def share(self) -> float:
        """Difference as a share of 1/m."""
        return self.after / self.before - 1

    @property
    def doubt(self) -> float:
        """Relative standard deviation of 1/m that follows from the difference alone.

        Parts with the shares w and 1 - w of the information differ by chance with the variance s^2 / (w (1 - w)), where
        s^2 is that of the whole. So sqrt(w (1 - w)) times the difference has the sd of the whole if nothing changed,
        and grows with any change between the parts.
        """
        weight = self.variance_after / (self.variance_before + self.variance_after)
        return abs(self.share) * float(np.sqrt(max(weight * (1 - weight), 0.0)))

    @property
    def contradiction(self) -> str:
        """Reason why the parts contradict each other; empty where noise or the form of the model explain it."""
        sd = float(np.sqrt(self.variance_before + self.variance_after))
        if abs(self.after - self.before) < MIN_MASS_CHANGE_SDS * sd or abs(self.share) < MIN_MASS_CHANGE_SHARE:
            return ""
        masses = f"mass {1 / self.before:.4g} and {1 / self.after:.4g} kg"
        return f"two parts of the drive contradict each other: {masses}"


def mass_changes(strides: Strides, found: RoadFit, seed: int) -> list[Change]:
    """Of the ``strides`` of a fit, cut after each of PARTS but the last; none where a part does not determine the mass.

    ``seed`` of the simulated noise in the corrections.
    """
    known = np.flatnonzero(strides.known)
    cuts = [int(known[len(known) * k // PARTS]) for k in range(1, PARTS)]
    inverse, weight = [], []
    for first, end in zip([0, *cuts], [*cuts, len(strides)], strict=True):
        rng = np.random.default_rng(seed)
        part = fit_given(strides[first:end], rng, found.scales, found.terms, departures=found.departures)
        if part is None or part.beta[0] <= 0 or not part.covariance[0, 0] > 0:
            return []
        inverse.append(float(part.beta[0]))
        weight.append(1 / float(part.covariance[0, 0]))
    changes = []
    for k in range(1, PARTS):
        before, after = sum(weight[:k]), sum(weight[k:])
        mean_before = float(np.dot(weight[:k], inverse[:k])) / before
        mean_after = float(np.dot(weight[k:], inverse[k:])) / after
        changes.append(Change(mean_before, mean_after, 1 / before, 1 / after))
    return changes

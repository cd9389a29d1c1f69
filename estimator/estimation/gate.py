"""The coverage gate: tests whether a window is sufficient for an estimate, and whether a new one is due.

`missing_rows` tests for enough driving; `obstacle_to_estimate` for enough of the reachable speed-acceleration cells
and a small enough predicted standard deviation. Both return the reason of a failure, else an empty string. `has_news`
tests for enough rows since the last estimate, `wrong_sign_of` for acceleration without power, `wrong_unit_of`
for acceleration with too little.
"""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from estimator.estimates import Coverage
from estimator.estimation.window import Grid
from estimator.model.road_load import design
from estimator.settings import Gate as GateConfig
from estimator.signals import Floats

PEAK_QUANTILE = 0.999  # of the measured power: taken as the vehicle's maximum
MIN_PULLING_ACCELERATION = 0.1  # m/s^2, where most power must be positive: gravity alone gives it on a slope of 1 %
NAMES = ("A", "C", "mass")


@dataclass(frozen=True)
class Judged:
    """Parameters [A, C, m, ...] (p,) and their standard deviations (p,), the input of a gate."""

    theta: Floats
    sd: Floats


class Gate:
    """Tests of a window against the limits of the settings; has no other state."""

    def __init__(self, config: GateConfig, grid: Grid) -> None:
        self._config = config
        self._speed, self._acceleration = grid.centres()

    def coverage(self, counts: "np.ndarray[tuple[int], np.dtype[np.int64]]", theta: Floats, power: Floats) -> Coverage:
        """Count the occupied cells among those reachable with ``theta`` = [A, C, m] (3,) and ``power`` (n,) [W].

        ``counts`` (cells,) are the rows in each cell of the grid. A cell is reachable if its road load is positive and
        at most the PEAK_QUANTILE of the measured power, and its speed and acceleration are at most the largest driven.
        """
        occupied = counts >= self._config.cell_count
        seen = counts > 0
        if not seen.any() or not len(power):
            return Coverage(0, 0)
        load = design(self._speed, self._acceleration) @ theta
        reachable = (load > 0) & (load <= np.quantile(power, PEAK_QUANTILE))
        reachable &= self._speed <= self._speed[seen].max()
        reachable &= self._acceleration <= self._acceleration[seen].max()
        wanted = tuple(np.flatnonzero(reachable & ~occupied).tolist())
        return Coverage(int((occupied & reachable).sum()), int(reachable.sum()), wanted)

    def missing_rows(self, held: int, rejected: Counter[str]) -> str:
        """Reason if ``held`` rows are too few for a fit, with the most common reason of rejection; else empty."""
        if held >= self._config.minimum_samples:
            return ""
        others = f"; most others: {rejected.most_common(1)[0][0]}" if rejected else ""
        return f"{held} usable samples of the {self._config.minimum_samples} needed{others}"

    def obstacle_to_estimate(self, fit: Judged, coverage: Coverage) -> str:
        """Reason to withhold an estimate: the coverage or a predicted sd; empty if both are sufficient."""
        if reason := self.missing_coverage(coverage):
            return reason
        for name, value, sd, limit in zip(NAMES, fit.theta, fit.sd, self._config.relative_sd, strict=False):
            if not sd < limit * abs(value):
                return (
                    f"predicted sd of {name} is {100 * sd / abs(value):.0f} % of its value, above {100 * limit:.0f} %"
                )
        return ""

    def obstacle_to_value(self, i: int, value: float, sd: float) -> str:
        """Reason to withhold parameter ``i`` of NAMES with this value and sd; empty if the sd is small enough."""
        limit = self._config.relative_sd[i]
        if sd < limit * abs(value):
            return ""
        share = f"{100 * sd / abs(value):.0f} %" if value else "infinite"
        return f"sd of {NAMES[i]} is {share} of its value, above {100 * limit:.0f} %"

    def missing_coverage(self, coverage: Coverage) -> str:
        """Message with the share of the reachable cells driven, or with their number; empty if it is sufficient."""
        if coverage.occupied >= self._config.minimum_cells and coverage.fraction >= self._config.coverage:
            return ""
        if coverage.fraction >= self._config.coverage:
            reachable = f"{coverage.available} can be reached"
            return f"coverage {coverage.occupied} of the {self._config.minimum_cells} cells needed ({reachable})"
        share = f"{100 * coverage.fraction:.0f} % of the reachable speed-acceleration cells"
        return f"coverage {share} ({coverage.occupied} of {coverage.available})"


def has_news(config: GateConfig, added: int, at_last_estimate: int, held: int) -> bool:
    """True if enough of the rows ``added`` so far came after the last estimate, relative to those ``held``."""
    return added - at_last_estimate >= max(config.new_samples * held, 1)


def wrong_sign_of(power: Floats, acceleration: Floats) -> str:
    """Message if ``power`` (n,) [W] is not positive at positive ``acceleration`` (n,) [m/s^2]; else empty."""
    pulling = power[acceleration > MIN_PULLING_ACCELERATION]
    if len(pulling) and np.median(pulling) <= 0:
        return "power is not positive while the vehicle accelerates: check the sign of the torque"
    return ""


def wrong_unit_of(force: Floats, acceleration: Floats, lightest: float) -> str:
    """Message if the unit of the power cannot be right, which gives the ``force`` (n,) [N]; else empty.

    The force is more than mass times ``acceleration`` (n,) [m/s^2] while the vehicle pulls, but downhill. No vehicle
    has less than the ``lightest`` mass [kg].
    """
    is_pulling = acceleration > MIN_PULLING_ACCELERATION
    if not is_pulling.any():
        return ""
    most = float(np.quantile(force[is_pulling] / acceleration[is_pulling], PEAK_QUANTILE))
    if most >= lightest:
        return ""
    least = f"prior.mass_kg, which begins at {lightest:,.0f} kg"
    return f"power accelerates at most {most:,.0f} kg: check its unit, or {least}"

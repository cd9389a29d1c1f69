"""Checks that invalidate an estimate: of the speed and of the beliefs of the configuration.

A speed in the wrong unit fits well with a wrong mass, so the wheel speed is compared with the GPS speed. Beliefs of the
configuration are compared with the fit of the drive alone.
"""

from typing import Any

import numpy as np

from estimator.checkpoint.validation import Count, State, read
from estimator.estimation.gate import Judged
from estimator.samples import Rows
from estimator.settings import Prior
from estimator.signals import Role

MAX_BELIEF_SDS = 5.0  # sd by which a belief and the drive may differ
MAX_SCALE_DIFFERENCE = 0.1  # by which wheel and GPS speed may differ: worn tyres make 3 %, a wrong unit 60 %
MIN_SCALE_SPEED = 5.0  # m/s, above which they are compared: a GPS error of 0.5 m/s is within MAX_SCALE_DIFFERENCE
MIN_SCALE_ROWS = 600  # 1 min of rows, for a comparison


class SpeedScale:
    """Compares the wheel speed with the GPS speed, where the bus has one."""

    def __init__(self) -> None:
        self._rows, self._wheel, self._gps = 0, 0.0, 0.0

    def add(self, rows: Rows) -> None:
        """Take the rows in which both are known and fast enough to compare."""
        gps = rows.context.get(Role.GPS_SPEED)
        if gps is None:
            return
        both = np.isfinite(rows.speed) & np.isfinite(gps) & (rows.speed > MIN_SCALE_SPEED)
        self._rows += int(both.sum())
        self._wheel += float(rows.speed[both].sum())
        self._gps += float(gps[both].sum())

    def state(self) -> dict[str, Any]:
        """The state that `restore` reads."""
        return {"rows": self._rows, "wheel": self._wheel, "gps": self._gps}

    def restore(self, state: State) -> None:
        """Take the state of another one.

        Raises
        ------
        StateError
            The state is not that of a comparison.
        """
        self._rows = read(state, "rows", Count)
        self._wheel, self._gps = read(state, "wheel", float), read(state, "gps", float)

    def verdict(self) -> str:
        """Their difference in words; empty while they agree or cannot be compared."""
        if self._rows < MIN_SCALE_ROWS or abs(self._wheel - self._gps) <= MAX_SCALE_DIFFERENCE * self._gps:
            return ""
        ratio = self._wheel / self._gps if self._gps > 0 else np.inf
        return f"the wheel speed is {ratio:.2f} times the GPS speed: check its signal and unit"


def contradiction(prior: Prior, drive: Judged) -> str:
    """The worst contradiction of the drive alone with a belief of the configuration; empty if there is none."""
    beliefs = {"A": prior.A_belief_N, "C": prior.C_belief_N_s2_m2, "mass": prior.mass_belief_kg}
    worst, found = MAX_BELIEF_SDS, ""
    for i, (name, belief) in enumerate(beliefs.items()):
        if belief is not None:
            value, sd = float(drive.theta[i]), float(drive.sd[i])
            distance = abs(value - belief[0]) / float(np.hypot(sd, belief[1]))
            if distance > worst:
                worst = distance
                found = f"the drive says {name} {value:.4g} +- {sd:.2g}, the configuration believes {belief[0]:.4g}"
    return found

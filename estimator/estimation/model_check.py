"""Can the estimate be true at all: checks of the residual, of the speed, of the lag and of what was believed.

If the model holds, the residual P - X theta has no mean left in any part of the drive, whatever its noise. The
check splits the samples by the speed, the acceleration and the power that their *instruments* give, which share no
noise with the residual, and asks of each part whether its mean residual is both certain and large: certain against
the spread that autocorrelated residuals of this size have, large against the power itself. A long drive makes every
small imperfection certain; only large ones make an estimate worthless.

A speed in the wrong unit fits perfectly, with a wrong mass: only another speed can tell. So can only the drive whether
what the configuration believes holds for this vehicle.
"""

from typing import Any

import numpy as np

from estimator.checkpoint.validation import Count, State, read
from estimator.estimation.gate import Fitted
from estimator.estimation.moments import LAG_SD, ROAD_LOAD, Fit, block_means
from estimator.samples import Rows, Samples
from estimator.settings import Prior
from estimator.signals import Floats, Role

PARTS = 8  # quantile bins along each axis
CERTAIN = 5.0  # standard errors
LARGE = 0.15  # of the mean model power
LEAST_EXPLAINED = 0.5  # share of the variance of power, means over SLOW
SLOW = 50  # samples, 5 s
LONGEST_LAG_LEFT = 2 * LAG_SD  # s, after alignment
CONTRADICTION = 5.0  # sd between a belief and the drive
SPEED_SCALE = 0.1  # by which wheel and GPS speed may differ: worn tyres make 3 %, a wrong unit 60 %
SCALE_SPEED = 5.0  # m/s, above which they are compared
SCALE_ROWS = 600


class SpeedScale:
    """Compares the wheel speed with the GPS speed, where the bus has one."""

    def __init__(self) -> None:
        self._rows, self._wheel, self._gps = 0, 0.0, 0.0

    def add(self, rows: Rows) -> None:
        """Take the rows in which both are known and fast enough to compare."""
        gps = rows.context.get(Role.GPS_SPEED)
        if gps is None:
            return
        both = np.isfinite(rows.speed) & np.isfinite(gps) & (rows.speed > SCALE_SPEED)
        self._rows += int(both.sum())
        self._wheel += float(rows.speed[both].sum())
        self._gps += float(gps[both].sum())

    def state(self) -> dict[str, Any]:
        """What `restore` goes on from."""
        return {"rows": self._rows, "wheel": self._wheel, "gps": self._gps}

    def restore(self, state: State) -> None:
        """Have seen what another has seen.

        Raises
        ------
        StateError
            The state is not that of a comparison.
        """
        self._rows = read(state, "rows", Count)
        self._wheel, self._gps = read(state, "wheel", float), read(state, "gps", float)

    def verdict(self) -> str:
        """Empty while they agree or cannot be compared, else by how much they differ."""
        if self._rows < SCALE_ROWS or abs(self._wheel - self._gps) <= SPEED_SCALE * self._gps:
            return ""
        ratio = self._wheel / self._gps if self._gps > 0 else np.inf
        return f"the wheel speed is {ratio:.2f} times the GPS speed: check its signal and unit"


def contradiction(prior: Prior, drive: Fitted) -> str:
    """Empty when the beliefs of the configuration fit what the drive alone says, else the worst contradiction."""
    beliefs = {"A": prior.A_belief_N, "C": prior.C_belief_N_s2_m2, "mass": prior.mass_belief_kg}
    worst, found = CONTRADICTION, ""
    for i, (name, belief) in enumerate(beliefs.items()):
        if belief is not None:
            value, sd = float(drive.theta[i]), float(drive.sd[i])
            distance = abs(value - belief[0]) / float(np.hypot(sd, belief[1]))
            if distance > worst:
                worst = distance
                found = f"the drive says {name} {value:.4g} +- {sd:.2g}, the configuration believes {belief[0]:.4g}"
    return found


def misfit(samples: Samples, fit: Fit) -> str:
    """Empty when the fitted model describes ``samples``, else what it misses."""
    kept = samples[fit.kept]
    X, Z = (part[fit.kept] for part in fit.columns(samples))
    residual = kept.P - X @ fit.theta
    # Noise of dv/dt is most of the residual of a poor speed sensor; over seconds it is gone, and hills are not.
    explained = 1 - float(block_means(residual, SLOW).var() / block_means(kept.P, SLOW).var())
    if explained < LEAST_EXPLAINED:
        share = 100 * max(explained, 0.0)
        return f"the model explains {share:.0f} % of the power's variance: grade, or a wrong signal?"
    if abs(fit.theta[ROAD_LOAD]) - fit.sd[ROAD_LOAD] > LONGEST_LAG_LEFT:
        return f"power and speed are {fit.theta[ROAD_LOAD]:+.1f} s apart even after alignment: check their time stamps"
    model = Z @ np.where(np.arange(Z.shape[1]) == ROAD_LOAD, 0.0, fit.theta)
    # One residual counts for as much less as there are correlated ones around it.
    inflation = len(residual) / fit.effective
    axes = (("speed", "m/s", kept.zv), ("acceleration", "m/s²", kept.za), ("model power", "kW", model / 1e3))
    worst, found = 0.0, ""
    for name, unit, axis in axes:
        edges = np.quantile(axis, np.linspace(0, 1, PARTS + 1))
        part = np.clip(np.searchsorted(edges, axis, side="right") - 1, 0, PARTS - 1)
        for k in range(PARTS):
            share, z = _bias(residual[part == k], float(model.mean()), inflation)
            if abs(z) > CERTAIN and abs(share) > max(LARGE, abs(worst)):
                worst = share
                place = f"{name} {edges[k]:.3g}..{edges[k + 1]:.3g} {unit}"
                found = f"{100 * share:+.0f} % of the mean power is left at {place}"
    return found


def _bias(residual: Floats, power: float, inflation: float) -> tuple[float, float]:
    """Mean residual as a share of ``power`` [W], and in standard errors."""
    if len(residual) < 2:
        return 0.0, 0.0
    mean = float(residual.mean())
    error = float(residual.std()) * np.sqrt(inflation / len(residual))
    return mean / power, mean / error if error > 0 else 0.0

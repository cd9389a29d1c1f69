"""Checks that invalidate an estimate: of the residual, the speed, the lag and the beliefs of the configuration.

If the model holds, the residual P - X theta has mean zero in every part of the drive, whatever its noise. The samples
are split by the speed, the acceleration and the power of their *instruments*, whose noise is independent of the
residual. A part contradicts the model if its mean residual is both significant (against the standard error of
autocorrelated residuals) and large (against the power). On a long drive small errors of the model are significant too;
only large ones invalidate the estimate.

A speed in the wrong unit fits well with a wrong mass, so the wheel speed is compared with the GPS speed. Beliefs of the
configuration are compared with the fit of the drive alone.
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
MIN_STANDARD_ERRORS = 5.0  # of the mean residual: in one of 3 x PARTS, Gaussian noise exceeds it in 1e-5 of fits
MIN_BIAS_SHARE = 0.15  # mean residual over the mean model power, from which it is large; good drives have 0.03
MIN_EXPLAINED = 0.5  # share of the variance of power, means over BLOCK_SAMPLES
BLOCK_SAMPLES = 50  # 5 s
MAX_LAG_LEFT = 2 * LAG_SD  # s, after alignment
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


def contradiction(prior: Prior, drive: Fitted) -> str:
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


def misfit(samples: Samples, fit: Fit) -> str:
    """Reason why the fitted model does not describe ``samples``; empty if it does."""
    kept = samples[fit.kept]
    X, Z = (part[fit.kept] for part in fit.columns(samples))
    residual = kept.P - X @ fit.theta
    # Noise of dv/dt dominates the residual of a noisy speed sensor. Means over seconds remove it, but not hills.
    explained = 1 - float(block_means(residual, BLOCK_SAMPLES).var() / block_means(kept.P, BLOCK_SAMPLES).var())
    if explained < MIN_EXPLAINED:
        share = 100 * max(explained, 0.0)
        return f"the model explains {share:.0f} % of the power's variance: grade, or a wrong signal?"
    if abs(fit.theta[ROAD_LOAD]) - fit.sd[ROAD_LOAD] > MAX_LAG_LEFT:
        return f"power and speed are {fit.theta[ROAD_LOAD]:+.1f} s apart even after alignment: check their time stamps"
    model = Z @ np.where(np.arange(Z.shape[1]) == ROAD_LOAD, 0.0, fit.theta)
    # Autocorrelated residuals: the standard error is larger by the square root of the correlation time.
    inflation = len(residual) / fit.effective
    axes = (("speed", "m/s", kept.zv), ("acceleration", "m/s²", kept.za), ("model power", "kW", model / 1e3))
    worst, found = 0.0, ""
    for name, unit, axis in axes:
        edges = np.quantile(axis, np.linspace(0, 1, PARTS + 1))
        part = np.clip(np.searchsorted(edges, axis, side="right") - 1, 0, PARTS - 1)
        for k in range(PARTS):
            share, z = _bias(residual[part == k], float(model.mean()), inflation)
            if abs(z) > MIN_STANDARD_ERRORS and abs(share) > max(MIN_BIAS_SHARE, abs(worst)):
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

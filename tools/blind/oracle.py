"""Visibility of an effect to an oracle that knows its true shape and the true noise, but not its size.

In blocks of BLOCK seconds, measured power is

    P = A v + C v^3 + m v a + sum_i d_i + noise,        noise = w (torque errors) + m v (error of the mean dv/dt)

with the true v, a, engine speed w and effect powers d_i. The covariance K of the noise is that of the generator:
first-order autoregressive and white torque errors and the rounding of the bus; and, from white speed noise averaged
over a block at either edge, differences of neighbours. (The rounding of the friction torque is left out: it is a
fixed function of engine speed, which the project recovers.) The prior of the relative size k of an effect is N(0, 1),
its true value is 1, and A, C, m, the lag of power (columns X) and all other effects are free. Then the expected log
Bayes factor is

    (s^4 / (1 + s^2) - ln(1 + s^2)) / 2,        s^2 = d' M d,   M = W - W X (X' W X)^-1 X' W,   W = K^-1

(conjugate normal prior, e.g. Bishop 2006, section 3.3). No code of the diagnosis is used.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import log1p
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

BLOCK = 0.5  # s
MARGIN = 1.5  # s left out on either side of brake use and shifts
MIN_SPEED = 1.0  # m/s
REACH = 10.0  # width of the covariance in correlation times of the torque noise
UNUSED = 1e6  # times the largest variance, for blocks without driving

Floats = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True, kw_only=True)
class Noise:
    """Errors of the sensors, as the generator makes them.

    ``torque_sd`` [N.m] with correlation time ``torque_time`` [s]; ``torque_white_sd`` [N.m] and rounding
    ``torque_step`` [N.m] of readings every ``torque_period`` [s]; white ``speed_sd`` [m/s] and rounding
    ``speed_step`` [m/s] of readings every ``speed_period`` [s].
    """

    torque_sd: float
    torque_time: float
    torque_white_sd: float
    torque_step: float
    torque_period: float
    speed_sd: float
    speed_step: float
    speed_period: float

    @property
    def torque_block_variance(self) -> float:
        """Variance [(N.m)^2] of the torque error that is independent between blocks.

        Rounding averages out where the white noise is larger than a step; otherwise its error is constant in a block.
        """
        readings = BLOCK / self.torque_period
        dithered = self.torque_white_sd > 0.5 * self.torque_step
        return self.torque_white_sd**2 / readings + self.torque_step**2 / 12 / (readings if dithered else 1.0)

    @property
    def edge_variance(self) -> float:
        """Variance [(m/s)^2] of a speed averaged over one block."""
        return (self.speed_sd**2 + self.speed_step**2 / 12) * self.speed_period / BLOCK


@dataclass(frozen=True, slots=True, kw_only=True)
class Driven:
    """A drive in blocks: columns ``X`` (n, 3) of A, C, m, ``effects`` (n, k) [W], blocks ``used`` (n,).

    ``rate`` of power (n,) [W/s] is the column of a lag; ``band`` (width, n) the lower band of the covariance [W^2].
    """

    X: Floats
    rate: Floats
    effects: Floats
    used: Mask
    band: Floats

    @classmethod
    def of(
        cls,
        step: float,
        v: Floats,
        a: Floats,
        power: Floats,
        engine_speed: Floats,
        free: Mask,
        effects: Sequence[Floats],
        mass: float,
        noise: Noise,
    ) -> "Driven":
        """Blocks of a drive, arrays (n,) every ``step`` [s]; ``free``: brake released and clutch closed."""
        size = round(BLOCK / step)
        n = len(v) // size

        def mean(x: Floats) -> Floats:
            means: Floats = x[: n * size].reshape(n, size).mean(axis=1)
            return means

        def throughout(state: Mask) -> Mask:
            whole: Mask = mean(state.astype(float)) == 1.0
            return whole

        reach = round(MARGIN / BLOCK)
        near = np.convolve(~throughout(free), np.ones(2 * reach + 1), mode="same") > 0
        used = ~near & throughout((power > 0.0) & (v > MIN_SPEED))
        X = np.column_stack([mean(v), mean(v**3), mean(v * a)])
        rate = mean(np.gradient(power, step))
        d = np.column_stack([mean(effect) for effect in effects]) if effects else np.empty((n, 0))
        band = covariance(mean(engine_speed), mass * X[:, 0], used, noise)
        return cls(X=X, rate=rate, effects=d, used=used, band=band)

    def weigh(self, columns: Floats) -> Floats:
        """Columns (n, k) times the inverse covariance."""
        weighed: Floats = solveh_banded(self.band, columns, lower=True)
        return weighed


def covariance(engine_speed: Floats, momentum: Floats, used: Mask, noise: Noise) -> Floats:
    """Lower band (width, n) of the noise's covariance [W^2] over the blocks (n,)."""
    n = len(engine_speed)
    width = min(n, 2 + round(REACH * noise.torque_time / BLOCK))
    band = np.zeros((width, n))
    for k in range(width):
        # The taper is a triangle, itself a covariance, so the product stays positive definite.
        torque = noise.torque_sd**2 * np.exp(-k * BLOCK / noise.torque_time) * (1 - k / width)
        band[k, : n - k] = torque * engine_speed[: n - k] * engine_speed[k:]
    band[0] += noise.torque_block_variance * engine_speed**2
    edge = noise.edge_variance / BLOCK**2
    band[0] += 2 * edge * momentum**2
    band[1, : n - 1] -= edge * momentum[:-1] * momentum[1:]
    band[0, ~used] += UNUSED * band[0].max()
    return band


def signal_to_noise(drive: Driven, effect: int, aligned: bool = False) -> float:
    """Squared signal to noise ratio of an effect beyond A, C, m, the others and, unless ``aligned``, a lag."""
    X = np.column_stack([drive.X, np.delete(drive.effects, effect, axis=1)])
    if not aligned:
        X = np.column_stack([X, np.where(drive.used, drive.rate, 0.0)])
    X = X / np.maximum(np.sqrt((X**2).mean(axis=0)), np.finfo(float).tiny)
    d = drive.effects[:, effect]
    weighed = drive.weigh(np.column_stack([X, d]))
    cross = X.T @ weighed[:, -1]
    explained = cross @ np.linalg.lstsq(X.T @ weighed[:, :-1], cross, rcond=None)[0]
    return max(float(d @ weighed[:, -1] - explained), 0.0)


def log_bayes_factor(s2: float) -> float:
    """Expected log Bayes factor of an effect of true size whose size is N(0, true size) beforehand."""
    return 0.5 * (s2 * s2 / (1.0 + s2) - log1p(s2))


def left_over(drive: Driven, effect: int) -> float:
    """Root mean square [W] of the residual of an effect after least squares on A, C, m."""
    X, d = drive.X[drive.used], drive.effects[drive.used, effect]
    if len(d) == 0:
        return 0.0
    residual = d - X @ np.linalg.lstsq(X, d, rcond=None)[0]
    return float(np.sqrt(np.mean(residual**2)))


def gap_closed(first: Driven, second: Driven, effects: Sequence[int]) -> float:
    """Share of the gap on a ``second`` drive that adding ``effects`` with their true parameters closes.

    A, C, m come from the ``first`` drive, fitted with and without the effects; the gap is the mean squared power that
    the model misses, without noise.
    """
    before = _missed(first, second, ())
    return 1.0 - _missed(first, second, effects) / before if before > 0 else 1.0


def _missed(first: Driven, second: Driven, known: Sequence[int]) -> float:
    unknown = [i for i in range(first.effects.shape[1]) if i not in known]
    rest = first.effects[:, unknown].sum(axis=1)
    weighed = first.weigh(np.column_stack([first.X, rest]))
    theta = np.linalg.lstsq(first.X.T @ weighed[:, :-1], first.X.T @ weighed[:, -1], rcond=None)[0]
    left = second.effects[:, unknown].sum(axis=1) - second.X @ theta
    return float(np.mean(left[second.used] ** 2))


def subsets(names: Sequence[str]) -> Mapping[tuple[str, ...], tuple[int, ...]]:
    """Every set of one or more names, and their indices."""
    chosen = range(1, 1 << len(names))
    places = [tuple(i for i in range(len(names)) if bits >> i & 1) for bits in chosen]
    return {tuple(names[i] for i in place): place for place in places}

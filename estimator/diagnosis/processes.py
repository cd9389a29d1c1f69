"""What is left, with no name: Gaussian processes that any unmodelled effect would excite.

The residual is averaged over some seconds of admitted driving: noise of dv/dt is gone, and what remains of the sensors'
noise is a first-order autoregression. A process adds the covariance s^2 g_i k(x_i, x_j) g_j: a force, power or drag g
that wanders over time or distance x, or goes with gear, speed or power alone. Its evidence is the marginal likelihood
of the averaged residual with A, C, m refitted (diffuse), averaged over its scales, divided by that of noise alone.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.special import log_ndtr, logsumexp

from estimator.diagnosis.model import Model
from estimator.estimation.moments import ROAD_LOAD
from estimator.signals import Floats, Mask, Quantity

SHORTEST_GRAIN = 40  # samples, 4 s
GRAINS = 500  # about as many, for a long drive
CORRELATIONS = (0.0, 0.25, 0.5, 0.7)  # of the noise, from one grain to the next
STRENGTHS = (0.1, 0.3, 1.0, 3.0)  # variance of the process over that of the residual
DIFFUSE = 1e4  # variance of the refitted base, over that of the residual
SHORTEST_PERIOD, LONGEST_PERIOD = 20.0, 600.0  # s, of a ripple
FINENESS = 0.25  # step of its frequency, over the inverse length of the drive


@dataclass(frozen=True)
class Grains:
    """The residual and the columns of the model, averaged; all with n rows."""

    residual: Floats  # [W]
    columns: Floats  # (n, p)
    t: Floats
    distance: Floats
    v: Floats
    power: Floats  # [W], as the instruments see it
    gear: Floats | None
    engine_speed: Floats  # [rad/s], or the speed where it is not known
    starts: NDArray[np.int64]  # first sample of each, of those left out too
    full: Mask  # which of them are long enough

    def __len__(self) -> int:
        return len(self.residual)

    @cached_property
    def noises(self) -> list[Floats]:
        """Covariance (n, n) without a process, up to scale, for each correlation of the noise."""
        order = np.abs(np.subtract.outer(np.arange(len(self)), np.arange(len(self))))
        columns = self.columns / np.sqrt((self.columns**2).mean(axis=0))
        diffuse = DIFFUSE * columns @ columns.T
        return [(rho**order if rho else np.eye(len(self))) + diffuse for rho in CORRELATIONS]

    @cached_property
    def factors(self) -> list[Floats]:
        """Lower Cholesky factors of `noises`."""
        return [np.linalg.cholesky(noise) for noise in self.noises]

    def off_base(self, x: Floats) -> Floats:
        """What of ``x`` (n,) the base model does not take up."""
        rest: Floats = x - self.columns @ np.linalg.lstsq(self.columns, x, rcond=None)[0]
        return rest

    def mean(self, x: Floats) -> Floats:
        """Averages of ``x`` (samples, ...) over the grains."""
        count = np.diff(np.append(self.starts, len(x)))
        averaged: Floats = (np.add.reduceat(x, self.starts, axis=0).T / count).T[self.full]
        return averaged


@dataclass(frozen=True)
class Process:
    """A class of unknown effects: what it is proportional to, and what it wanders over."""

    name: str
    gain: Callable[[Grains], Floats]
    kernels: Callable[[Grains], list[Floats]]


@dataclass(frozen=True)
class Leftover:
    """Evidence of a process on a residual: log Bayes factor, variance it explains [W^2], smoothed estimate [W] (n,)."""

    name: str
    log_bayes_factor: float
    variance: float
    smooth: Floats


def _wander(x: Callable[[Grains], Floats], lengths: tuple[float, ...]) -> Callable[[Grains], list[Floats]]:
    def kernels(grains: Grains) -> list[Floats]:
        distance = np.abs(np.subtract.outer(x(grains), x(grains)))
        rough = [np.exp(-distance / length) for length in lengths]
        # Matern 3/2, for what has no corners.
        smooth = [(1 + d) * np.exp(-d) for d in (2 * distance / length for length in lengths)]
        return rough + smooth

    return kernels


def _gears(grains: Grains) -> list[Floats]:
    if grains.gear is None:
        return []
    return [np.equal.outer(grains.gear, grains.gear).astype(float)]


MINUTES = (60.0, 300.0, 1200.0)  # s
HILLS = (150.0, 400.0, 1000.0, 3000.0, 9000.0, 30000.0)  # m, as far as MINUTES of driving
SPEEDS = (1.0, 3.0, 10.0)  # m/s
ENGINE_SPEEDS = (5.0, 20.0)  # rad/s
POWERS = (2e4, 6e4)  # W
UNMEASURED_GRADE = "force over distance"
POWER_OVER_TIME = "power over time"
PROCESSES: tuple[Process, ...] = (
    Process(POWER_OVER_TIME, lambda g: np.ones(len(g)), _wander(lambda g: g.t, MINUTES)),
    Process("force over time", lambda g: g.v, _wander(lambda g: g.t, MINUTES)),
    Process("drag over time", lambda g: g.v**3, _wander(lambda g: g.t, MINUTES)),
    Process(UNMEASURED_GRADE, lambda g: g.v, _wander(lambda g: g.distance, HILLS)),
    Process("gain over time", lambda g: g.power, _wander(lambda g: g.t, MINUTES)),
    Process("power by gear", lambda g: np.ones(len(g)), _gears),
    Process("torque by gear", lambda g: g.engine_speed, _gears),
    Process("power over speed", lambda g: np.ones(len(g)), _wander(lambda g: g.v, SPEEDS)),
    Process("force over speed", lambda g: g.v, _wander(lambda g: g.v, SPEEDS)),
    Process("power over engine speed", lambda g: np.ones(len(g)), _wander(lambda g: g.engine_speed, ENGINE_SPEEDS)),
    Process("power over power", lambda g: np.ones(len(g)), _wander(lambda g: g.power, POWERS)),
)


def grains_of(model: Model) -> Grains:
    """Average the residual of ``model``; grains do not reach across gaps of the admitted driving."""
    s = model.samples
    piece = np.concatenate([[0], np.cumsum(np.diff(s.t) > 3.0)])
    position = np.arange(len(s)) - np.searchsorted(piece, piece)
    grain = max(SHORTEST_GRAIN, len(s) // GRAINS)
    label = piece * (len(s) // grain + 1) + position // grain
    starts = np.flatnonzero(np.diff(label, prepend=label[0] - 1))
    count = np.diff(np.append(starts, len(s)))
    full = count >= grain // 2

    def mean(x: Floats) -> Floats:
        averaged: Floats = (np.add.reduceat(x, starts, axis=0).T / count).T[full]
        return averaged

    gear = s.context.get(Quantity.GEAR)
    power = model.base.Z[:, :ROAD_LOAD] @ model.base.theta[:ROAD_LOAD]
    return Grains(
        mean(model.base.residual),
        mean(model.base.X),
        mean(s.t),
        mean(s.context[Quantity.DISTANCE]),
        mean(s.v),
        mean(power),
        None if gear is None else np.round(mean(gear)),
        mean(s.context.get(Quantity.ENGINE_SPEED, s.v)),
        starts,
        full,
    )


@dataclass(frozen=True)
class Weight:
    """What the averaged residual says about k columns, each alone: log Bayes factor, value, sd; all arrays (k,)."""

    log_bayes_factor: Floats
    value: Floats
    sd: Floats


def weigh(grains: Grains, columns: Floats, usual: float, positive: bool) -> Weight:
    """Evidence of each of ``columns`` (n, k) [W]; Gaussian prior of sd ``usual``, or half of one."""
    n, y = len(grains), grains.residual
    none, some, values, sds = [], [], [], []
    for factor in grains.factors:
        white = solve_triangular(factor, np.column_stack([y, columns]), lower=True, check_finite=False)
        a, c = white[:, 0], white[:, 1:]
        total, cross, strength = float(a @ a), a @ c, np.maximum((c**2).sum(axis=0), np.finfo(float).tiny)
        # The noise's variance as the column leaves it.
        left = np.maximum(total - cross**2 / strength, 1e-9 * total) / n
        precision = strength / left + 1.0 / usual**2
        value, sd = cross / left / precision, precision**-0.5
        determinant = -float(np.log(np.diag(factor)).sum())
        none.append(determinant - 0.5 * n * np.log(total))
        log = determinant - 0.5 * n * np.log(total - value**2 * precision * left) - 0.5 * np.log(precision * usual**2)
        some.append(log + (log_ndtr(value / sd) + np.log(2) if positive else 0.0))
        values.append(value)
        sds.append(sd)
    best = np.argmax(some, axis=0)
    which = np.arange(columns.shape[1])
    factor = logsumexp(some, axis=0) - logsumexp(none)
    return Weight(np.asarray(factor), np.stack(values)[best, which], np.stack(sds)[best, which])


def ripple(grains: Grains) -> Leftover:
    """A torque or power that swings with one period all through the drive."""
    span = float(grains.t[-1] - grains.t[0])
    frequency = np.arange(1 / LONGEST_PERIOD, 1 / SHORTEST_PERIOD, FINENESS / span)
    angle = 2 * np.pi * np.outer(grains.t - grains.t[0], frequency)
    best = Leftover("swings in time", -np.inf, 0.0, np.zeros(len(grains)))
    for gain in (np.ones(len(grains)), grains.engine_speed):
        gain = gain / np.sqrt(np.mean(gain**2))
        waves = np.stack([np.cos(angle), np.sin(angle)]) * gain[:, None]
        cosine, sine = (weigh(grains, wave, float(grains.residual.std()), positive=False) for wave in waves)
        evidence = cosine.log_bayes_factor + sine.log_bayes_factor
        peak = int(np.argmax(evidence))
        total = float(logsumexp(evidence)) - np.log(len(frequency))
        if total > best.log_bayes_factor:
            smooth = grains.off_base(waves[0][:, peak] * cosine.value[peak] + waves[1][:, peak] * sine.value[peak])
            best = Leftover(f"swings every {1 / frequency[peak]:.0f} s", total, float(np.mean(smooth**2)), smooth)
    return best


def leftovers(grains: Grains) -> list[Leftover]:
    """All processes on a residual, most evidence first."""
    n = len(grains)
    y = grains.residual
    scale = float(y.var())
    noises = grains.noises
    plain = [_log_likelihood(y / np.sqrt(scale), noise)[0] for noise in noises]
    none = float(logsumexp(plain)) - np.log(len(noises))
    found = [ripple(grains)]
    for process in PROCESSES:
        gain = process.gain(grains)
        gain = gain / np.sqrt(np.mean(gain**2))
        kernels = process.kernels(grains)
        if not kernels:
            continue
        best: tuple[float, float, Floats] = (-np.inf, 0.0, np.zeros(n))
        total: list[float] = []
        for kernel in kernels:
            shape = np.outer(gain, gain) * kernel
            for strength in STRENGTHS:
                for noise in noises:
                    value, weights = _log_likelihood(y / np.sqrt(scale), noise + strength * shape)
                    total.append(value)
                    if value > best[0]:
                        smooth = grains.off_base(strength * shape @ weights)
                        best = (value, float(np.mean(smooth**2)), smooth)
        lbf = float(logsumexp(total)) - np.log(len(total)) - none
        found.append(Leftover(process.name, lbf, best[1] * scale, best[2] * np.sqrt(scale)))
    return sorted(found, key=lambda leftover: -leftover.log_bayes_factor)


def _log_likelihood(y: Floats, covariance: Floats) -> tuple[float, Floats]:
    """Gaussian log likelihood with the overall variance integrated out (prior 1 / s^2), and covariance^-1 y."""
    factor = cho_factor(covariance, lower=True, check_finite=False)
    weights = cho_solve(factor, y, check_finite=False)
    log_determinant = 2 * float(np.log(np.diag(factor[0])).sum())
    return -0.5 * log_determinant - 0.5 * len(y) * float(np.log(y @ weights)), weights

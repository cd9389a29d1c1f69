"""Nameless processes: Gaussian processes for effects that the catalogue does not have.

A process adds the covariance s^2 g_i k(x_i, x_j) g_j: a force, power or drag g that varies over time or distance x, or
depends on gear, speed or power alone. Its evidence is the marginal likelihood of the averaged residual with A, C, m
refitted (diffuse), averaged over its scales, divided by that of noise alone.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import logsumexp

from estimator.diagnosis.averaged_residual import Averages, weigh
from estimator.signals import Floats

STRENGTHS = (0.1, 0.3, 1.0, 3.0)  # variance of the process over that of the residual
MIN_PERIOD, MAX_PERIOD = 20.0, 600.0  # s, of a ripple
FREQUENCY_STEP = 0.25  # step of its frequency, over the inverse length of the drive


@dataclass(frozen=True)
class Process:
    """A class of unknown effects: ``gain`` (n,) it is proportional to, ``kernels`` (n, n) of its variation."""

    name: str
    gain: Callable[[Averages], Floats]
    kernels: Callable[[Averages], list[Floats]]


@dataclass(frozen=True, kw_only=True)
class Leftover:
    """Evidence of a process on a residual: log Bayes factor, variance it explains [W^2], smoothed estimate [W] (n,).

    ``covariances``: of the process over that of the noise, (n, n) for each drive.
    """

    name: str
    log_bayes_factor: float
    variance: float
    smooth: Floats
    covariances: tuple[Floats, ...]


def _wander(x: Callable[[Averages], Floats], lengths: tuple[float, ...]) -> Callable[[Averages], list[Floats]]:
    def kernels(averages: Averages) -> list[Floats]:
        distance = np.abs(np.subtract.outer(x(averages), x(averages)))
        rough = [np.exp(-distance / length) for length in lengths]
        # Matern 3/2: its functions have a continuous slope.
        smooth = [(1 + d) * np.exp(-d) for d in (2 * distance / length for length in lengths)]
        return rough + smooth

    return kernels


def _gears(averages: Averages) -> list[Floats]:
    if averages.gear is None:
        return []
    return [np.equal.outer(averages.gear, averages.gear).astype(float)]


MINUTES = (60.0, 300.0, 1200.0)  # s
GUSTS = (15.0, *MINUTES)  # s, of force and drag; a gain that varies within 15 s cannot be told from noise of dv/dt
HILLS = (150.0, 400.0, 1000.0, 3000.0, 9000.0, 30000.0)  # m; the longest is the distance of MINUTES of driving
SPEEDS = (1.0, 3.0, 10.0)  # m/s
ENGINE_SPEEDS = (5.0, 20.0)  # rad/s
POWERS = (2e4, 6e4)  # W
UNMEASURED_GRADE = "force over distance"
POWER_OVER_TIME, FORCE_OVER_TIME, DRAG_OVER_TIME = "power over time", "force over time", "drag over time"
PROCESSES: tuple[Process, ...] = (
    Process(POWER_OVER_TIME, lambda g: np.ones(len(g)), _wander(lambda g: g.t, MINUTES)),
    Process(FORCE_OVER_TIME, lambda g: g.v, _wander(lambda g: g.t, GUSTS)),
    Process(DRAG_OVER_TIME, lambda g: g.v**3, _wander(lambda g: g.t, GUSTS)),
    Process(UNMEASURED_GRADE, lambda g: g.v, _wander(lambda g: g.distance, HILLS)),
    Process("gain over time", lambda g: g.power, _wander(lambda g: g.t, MINUTES)),
    Process("power by gear", lambda g: np.ones(len(g)), _gears),
    Process("torque by gear", lambda g: g.engine_speed, _gears),
    Process("power over speed", lambda g: np.ones(len(g)), _wander(lambda g: g.v, SPEEDS)),
    Process("force over speed", lambda g: g.v, _wander(lambda g: g.v, SPEEDS)),
    Process("power over engine speed", lambda g: np.ones(len(g)), _wander(lambda g: g.engine_speed, ENGINE_SPEEDS)),
    Process("power over power", lambda g: np.ones(len(g)), _wander(lambda g: g.power, POWERS)),
)


def ripple(averages: Averages) -> Leftover:
    """A torque or power that oscillates with one period during the whole drive."""
    span = float(averages.t[-1] - averages.t[0])
    frequency = np.arange(1 / MAX_PERIOD, 1 / MIN_PERIOD, FREQUENCY_STEP / span)
    angle = 2 * np.pi * np.outer(averages.t - averages.t[0], frequency)
    nothing = np.zeros(len(averages))
    best = Leftover(
        name="swings", log_bayes_factor=-np.inf, variance=0.0, smooth=nothing, covariances=(np.outer(nothing, nothing),)
    )
    for gain in (np.ones(len(averages)), averages.engine_speed):
        gain = gain / np.sqrt(np.mean(gain**2))
        waves = np.stack([np.cos(angle), np.sin(angle)]) * gain[:, None]
        cosine, sine = (weigh(averages, wave, float(averages.residual.std()), positive=False) for wave in waves)
        evidence = cosine.log_bayes_factor + sine.log_bayes_factor
        peak = int(np.argmax(evidence))
        total = float(logsumexp(evidence)) - np.log(len(frequency))
        if total > best.log_bayes_factor:
            smooth = averages.off_base(waves[0][:, peak] * cosine.value[peak] + waves[1][:, peak] * sine.value[peak])
            variance = float(np.mean(smooth**2))
            pair = waves[:, :, peak].T * np.sqrt(variance / averages.residual.var())
            best = Leftover(
                name=f"swings every {1 / frequency[peak]:.0f} s",
                log_bayes_factor=total,
                variance=variance,
                smooth=smooth,
                covariances=(pair @ pair.T,),
            )
    return best


def leftovers(averages: Averages) -> list[Leftover]:
    """All processes on a residual, most evidence first."""
    n = len(averages)
    y = averages.residual
    scale = float(y.var())
    noises = averages.noises
    plain = [_log_likelihood(y / np.sqrt(scale), noise)[0] for noise in noises]
    none = float(logsumexp(plain)) - np.log(len(noises))
    found = [ripple(averages)]
    for process in PROCESSES:
        gain = process.gain(averages)
        gain = gain / np.sqrt(np.mean(gain**2))
        kernels = process.kernels(averages)
        if not kernels:
            continue
        best: tuple[float, float, Floats, Floats] = (-np.inf, 0.0, np.zeros(n), np.zeros((n, n)))
        total: list[float] = []
        for kernel in kernels:
            shape = np.outer(gain, gain) * kernel
            for strength in STRENGTHS:
                for noise in noises:
                    value, weights = _log_likelihood(y / np.sqrt(scale), noise + strength * shape)
                    total.append(value)
                    if value > best[0]:
                        smooth = averages.off_base(strength * shape @ weights)
                        best = (value, float(np.mean(smooth**2)), smooth, strength * shape)
        lbf = float(logsumexp(total)) - np.log(len(total)) - none
        found.append(
            Leftover(
                name=process.name,
                log_bayes_factor=lbf,
                variance=best[1] * scale,
                smooth=best[2] * np.sqrt(scale),
                covariances=(best[3],),
            )
        )
    return sorted(found, key=lambda leftover: -leftover.log_bayes_factor)


def _log_likelihood(y: Floats, covariance: Floats) -> tuple[float, Floats]:
    """Gaussian log likelihood with the overall variance integrated out (prior 1 / s^2), and covariance^-1 y."""
    factor = cho_factor(covariance, lower=True, check_finite=False)
    weights = cho_solve(factor, y, check_finite=False)
    log_determinant = 2 * float(np.log(np.diag(factor[0])).sum())
    return -0.5 * log_determinant - 0.5 * len(y) * float(np.log(y @ weights)), weights

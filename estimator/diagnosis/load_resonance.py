"""Oscillations after accelerations: a load on springs, a sloshing liquid, a loose coupling; no effect of the catalogue.

A mass s on a spring and a damper, of natural frequency w and damping ratio d, is displaced by x with
x'' + 2 d w x' + w^2 x = -a, and holds the vehicle back by s x'' more than if it were fixed. With its complex mode q,

    q' = L q + a,    L = w (-d + i sqrt(1 - d^2)),    x'' = -a - Im(L^2 q) / Im L

Means over some seconds contain nothing of it, so its evidence comes from every sample, as that of an effect does. The
column is h = v x''; its instrument is the oscillation from accelerations more than HOLE ago, whose readings are not in
the sample. The evidence is averaged over frequencies and damping ratios.

A low-pass of the speed leaves a similar residual. The evidence is the smaller of two: with a low-pass in the base
model, and without.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.signal import lfilter
from scipy.special import logsumexp

from estimator.diagnosis.averaged_residual import Averages
from estimator.diagnosis.drive_data import Record
from estimator.diagnosis.evidence import fit_base, log_bayes_factor, score
from estimator.diagnosis.lowpass import as_filtered
from estimator.diagnosis.model import BLOCK_SAMPLES, Model
from estimator.diagnosis.processes import Leftover
from estimator.estimation.moments import block_means
from estimator.model.design_matrix import MASS
from estimator.preparation.smoothing import HOLE, convolve
from estimator.samples import STEP
from estimator.signals import Floats

Indices = NDArray[np.int64]

PERIODS = 1.5 * 1.13 ** np.arange(12)  # s, up to 5.8
DAMPING_RATIOS = (0.05, 0.1, 0.2)
USUAL_SHARE = 0.2  # of the vehicle's mass, that swings: sd of its prior
MIN_MASS = 1.0  # kg, of a vehicle: keeps the prior positive where a fit gives none
SWING = "a mass that rings on after accelerations"


@dataclass(frozen=True)
class Swing:
    """One mass on a spring: its period [s], the column [W/kg] of its power with the instrument (n,), its size [kg]."""

    period: float
    h: Floats
    z: Floats
    mass: float


def swing(record: Record, model: Model, averages: Averages) -> Leftover:
    """Evidence of a mass that swings, in the residual of ``model`` on the drive of ``record``."""
    evidence, best = _find(record, model)
    base = model.base
    power = best.mass * (best.h - base.X @ (base.inverse @ (base.Z.T @ best.h)))  # beyond the refitted base model
    variance = float(np.mean(block_means(power, BLOCK_SAMPLES) ** 2))
    smooth = averages.mean(power)
    shape = smooth / averages.residual.std()
    return Leftover(
        name=f"{SWING} every {best.period:.1f} s",
        log_bayes_factor=evidence,
        variance=variance,
        smooth=smooth,
        covariances=(np.outer(shape, shape),),
    )


def with_swing(record: Record, model: Model) -> Model:
    """``model`` with the mass that swings as a further column, so that effects are judged beside it."""
    _, best = _find(record, model)
    base = model.base
    fitted = fit_base(np.column_stack([base.X, best.h]), np.column_stack([base.Z, best.z]), base.P, base.block)
    return model if fitted is None else replace(model, base=fitted)


def _find(record: Record, model: Model) -> tuple[float, Swing]:
    """Log Bayes factor of a mass that swings, and the one with most evidence."""
    usual = USUAL_SHARE * max(float(model.road_load[MASS]), MIN_MASS)
    at = record.at(model.samples)
    filtered = as_filtered(record, model)
    trust, bases = _trust(model), [model.base] if filtered is None else [model.base, filtered]
    evidence: list[Floats] = []
    found: list[tuple[float, Swing]] = []
    for ratio in DAMPING_RATIOS:
        h, z = _columns(record, model, at, ratio)
        z *= trust
        scores = [score(base, h, z) for base in bases]
        each = np.min([np.nan_to_num(log_bayes_factor(one, usual, positive=True)) for one in scores], axis=0)
        k = int(np.argmax(each))
        mass = float(np.nan_to_num(scores[0].value[k]))
        evidence.append(each)
        found.append((float(each[k]), Swing(float(PERIODS[k]), h[:, k].copy(), z[:, k].copy(), mass)))
    total = float(logsumexp(evidence) - np.log(len(DAMPING_RATIOS) * len(PERIODS)))
    return total, max(found, key=lambda pair: pair[0])[1]


def _columns(record: Record, model: Model, at: Indices, ratio: float) -> tuple[Floats, Floats]:
    """Power [W] per mass [kg] for all PERIODS, and its instruments, both (n, k)."""
    s, hole = model.samples, round(HOLE / STEP)
    a = np.diff(record.speed, prepend=record.speed[0]) / STEP
    h, z = np.empty((len(s), len(PERIODS))), np.empty((len(s), len(PERIODS)))
    for k, w in enumerate(2 * np.pi / PERIODS):
        mode = w * complex(-ratio, np.sqrt(1 - ratio**2))
        step = np.exp(mode * STEP)
        q = lfilter([(step - 1) / mode], [1.0, -step], a)
        ringing = -(mode**2) / mode.imag
        h[:, k] = s.v * (convolve((ringing * q).imag, record.smoother.value)[at] - s.a)
        z[:, k] = s.zv * (ringing * np.exp(mode * HOLE) * q[at - hole]).imag
    return h, z


def _trust(model: Model) -> Floats:
    """Inverse variance of each residual over the mean of all (n, 1): some of it grows with speed."""
    square = model.samples.v**2
    terms = np.column_stack([np.ones(len(square)), square / square.mean()])
    parts, _ = nnls(terms, model.base.residual**2)
    variance = np.maximum(terms @ parts, np.finfo(float).tiny)
    trust: Floats = (variance.mean() / variance)[:, None]
    return trust

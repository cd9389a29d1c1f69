"""What a model leaves, averaged over some seconds, and how strongly that speaks for a column of power.

Noise of dv/dt is gone from such means, and what remains of the sensors' noise is a first-order autoregression. The
road load is refitted (diffuse) beside everything that is judged on them.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.special import log_ndtr, logsumexp

from estimator.diagnosis.model import MAD_TO_SD, Model
from estimator.estimation.moments import ROAD_LOAD
from estimator.model.design_matrix import PLAIN
from estimator.signals import Floats, Mask, Quantity

SHORTEST_GRAIN = 40  # samples, 4 s
OUTLYING = 6.0  # sd of the residual beside effects that switch
GRAINS = 500  # about as many, for a long drive
CORRELATIONS = (0.0, 0.25, 0.5, 0.7)  # of the noise, from one grain to the next
DIFFUSE = 1e4  # variance of the refitted base, over that of the residual


@dataclass(frozen=True, kw_only=True)
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
    nuisance: Floats | None = None  # (n, n) covariance of a process taken for granted, over that of the noise

    def __len__(self) -> int:
        return len(self.residual)

    @cached_property
    def noises(self) -> list[Floats]:
        """Covariance (n, n) without a process, up to scale, for each correlation of the noise."""
        order = np.abs(np.subtract.outer(np.arange(len(self)), np.arange(len(self))))
        columns = self.columns / np.sqrt((self.columns**2).mean(axis=0))
        diffuse = DIFFUSE * columns @ columns.T
        known = diffuse if self.nuisance is None else diffuse + self.nuisance
        return [(rho**order if rho else np.eye(len(self))) + known for rho in CORRELATIONS]

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
    if any(term.spans for term in model.terms):
        # A moment at which something was on and is taken for off tells of the times found, and of nothing else.
        off = np.abs(np.add.reduceat(model.base.residual, starts) / count)
        full &= off < OUTLYING * MAD_TO_SD * np.median(off[full])

    def mean(x: Floats) -> Floats:
        averaged: Floats = (np.add.reduceat(x, starts, axis=0).T / count).T[full]
        return averaged

    # Where the measured power is in a column, so is the residual: as instruments see it, it is not.
    X = model.base.X.copy()
    for i, term in enumerate((term for term in model.terms if not term.joins_mass), start=PLAIN):
        if term.effect.is_noisy:
            X[:, i] = model.base.Z[:, i]
    gear = s.context.get(Quantity.GEAR)
    power = model.base.Z[:, :ROAD_LOAD] @ model.base.theta[:ROAD_LOAD]
    return Grains(
        residual=mean(model.base.residual),
        columns=mean(X),
        t=mean(s.t),
        distance=mean(s.context[Quantity.DISTANCE]),
        v=mean(s.v),
        power=mean(power),
        gear=None if gear is None else np.round(mean(gear)),
        engine_speed=mean(s.context.get(Quantity.ENGINE_SPEED, s.v)),
        starts=starts,
        full=full,
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

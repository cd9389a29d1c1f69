"""The residual of a model averaged over blocks of seconds, and the evidence of a column of power in it.

Such means contain no noise of dv/dt, and the rest of the sensors' noise is a first-order autoregression. The road load
is refitted with a diffuse prior beside every column that is judged.
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

MIN_BLOCK_SAMPLES = 40  # samples, 4 s
MAX_RESIDUAL_SDS = 6.0  # sd of a block's residual where effects switch: above, the switching time is wrong
MAX_BLOCKS = 500  # approximate number in a long drive: the cost grows with its cube
NOISE_CORRELATIONS = (0.0, 0.25, 0.5, 0.7)  # of the noise between neighbouring blocks; the evidence is their mean
DIFFUSE_VARIANCE = 1e4  # variance of the refitted base, over that of the residual


@dataclass(frozen=True, kw_only=True)
class Averages:
    """The residual and the columns of the model, averaged over n blocks; all arrays (n,) unless stated."""

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
        diffuse = DIFFUSE_VARIANCE * columns @ columns.T
        known = diffuse if self.nuisance is None else diffuse + self.nuisance
        return [(rho**order if rho else np.eye(len(self))) + known for rho in NOISE_CORRELATIONS]

    @cached_property
    def factors(self) -> list[Floats]:
        """Lower Cholesky factors (n, n) of `noises`."""
        return [np.linalg.cholesky(noise) for noise in self.noises]

    def off_base(self, x: Floats) -> Floats:
        """Residual (n,) of ``x`` (n,) after regression on the columns of the base model."""
        rest: Floats = x - self.columns @ np.linalg.lstsq(self.columns, x, rcond=None)[0]
        return rest

    def mean(self, x: Floats) -> Floats:
        """Averages (n, ...) of ``x`` (samples, ...) over the blocks."""
        count = np.diff(np.append(self.starts, len(x)))
        averaged: Floats = (np.add.reduceat(x, self.starts, axis=0).T / count).T[self.full]
        return averaged


def averages_of(model: Model) -> Averages:
    """Average the residual of ``model``; blocks do not reach across gaps of the admitted driving."""
    s = model.samples
    piece = np.concatenate([[0], np.cumsum(np.diff(s.t) > 3.0)])
    position = np.arange(len(s)) - np.searchsorted(piece, piece)
    block = max(MIN_BLOCK_SAMPLES, len(s) // MAX_BLOCKS)
    label = piece * (len(s) // block + 1) + position // block
    starts = np.flatnonzero(np.diff(label, prepend=label[0] - 1))
    count = np.diff(np.append(starts, len(s)))
    full = count >= block // 2
    if any(term.spans for term in model.terms):
        # Large residuals come from wrongly estimated switching times, so these blocks are left out.
        off = np.abs(np.add.reduceat(model.base.residual, starts) / count)
        full &= off < MAX_RESIDUAL_SDS * MAD_TO_SD * np.median(off[full])

    def mean(x: Floats) -> Floats:
        averaged: Floats = (np.add.reduceat(x, starts, axis=0).T / count).T[full]
        return averaged

    # A column computed from measured power contains the residual; its instrument does not.
    X = model.base.X.copy()
    for i, term in enumerate((term for term in model.terms if not term.joins_mass), start=PLAIN):
        if term.effect.is_noisy:
            X[:, i] = model.base.Z[:, i]
    gear = s.context.get(Quantity.GEAR)
    power = model.base.Z[:, :ROAD_LOAD] @ model.base.theta[:ROAD_LOAD]
    return Averages(
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
    """Evidence of k columns, each alone, in the averaged residual: log Bayes factor, value, sd; all arrays (k,)."""

    log_bayes_factor: Floats
    value: Floats
    sd: Floats


def weigh(averages: Averages, columns: Floats, usual: float, positive: bool) -> Weight:
    """Evidence of each of ``columns`` (n, k) [W]; Gaussian prior of sd ``usual``, or half of one."""
    n, y = len(averages), averages.residual
    none, some, values, sds = [], [], [], []
    for factor in averages.factors:
        white = solve_triangular(factor, np.column_stack([y, columns]), lower=True, check_finite=False)
        a, c = white[:, 0], white[:, 1:]
        total, cross, strength = float(a @ a), a @ c, np.maximum((c**2).sum(axis=0), np.finfo(float).tiny)
        # Variance of the noise after the fit of the column.
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

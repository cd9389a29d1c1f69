"""The road load with effects added, fitted to a drive."""

from dataclasses import dataclass

import numpy as np

from estimator.diagnosis.base import Base, blocks_of, fit_base
from estimator.diagnosis.drive_data import Record
from estimator.estimation.moments import block_means
from estimator.model.design_matrix import LAG, Term, columns
from estimator.samples import Samples
from estimator.signals import Floats, Mask

MAX_PASSES = 6  # alternations of fit and selection of samples; they stop when the selection stays the same
MIN_POWER_SDS = 3.0  # sd of the slow residual that model power must exceed for a sample to count
MAX_POWER_SHARE = 0.25  # of the mean power: a sample above it counts in any case
BLOCK_SAMPLES = 20  # 2 s: means over them contain no noise of dv/dt
MIN_SAMPLES = 600  # 1 min, for a fit
MAD_TO_SD = 1.4826  # of a Gaussian


@dataclass(frozen=True)
class Model:
    """The selected samples, the terms in the model, and its fit.

    Columns are those of the plain road load with the lag, [A, C, m, tau], then one for each term that does not join
    the mass.
    """

    samples: Samples
    terms: tuple[Term, ...]
    base: Base

    @property
    def road_load(self) -> Floats:
        """A [N], C [N s^2/m^2], m [kg] (3,)."""
        return self.base.theta[:3]


@dataclass(frozen=True)
class Drive:
    """One record with the plain model of it."""

    record: Record
    model: Model

    def having(self, terms: tuple[Term, ...]) -> "Drive":
        """The same drive with effects in its model; as before where they cannot be fitted."""
        model = fit(self.model.samples, terms)
        return self if model is None else Drive(self.record, model)


def select(samples: Samples, terms: tuple[Term, ...] = ()) -> Mask | None:
    """Samples (n,) whose model power, by their instruments, is clearly above 0; None where there are too few."""
    kept: Mask = np.ones(len(samples), dtype=np.bool_)
    road_load: Floats = np.zeros(3)
    for _ in range(MAX_PASSES):
        if kept.sum() < MIN_SAMPLES:
            return None
        fitted = _fit(samples[kept], terms, road_load)
        if fitted is None:
            return None
        road_load = fitted.theta[:3]
        _, Z = columns(samples, terms, road_load)
        predicted = Z @ fitted.theta
        slow = MAD_TO_SD * float(np.median(np.abs(block_means(fitted.residual, BLOCK_SAMPLES))))
        pulling = predicted > min(MIN_POWER_SDS * slow, MAX_POWER_SHARE * float(np.abs(samples.P).mean()))
        previous, kept = kept, pulling
        if np.array_equal(kept, previous):
            break
    return kept if kept.sum() >= MIN_SAMPLES else None


def fit(samples: Samples, terms: tuple[Term, ...] = ()) -> Model | None:
    """Fit the model with ``terms`` to ``samples``; None where they do not determine it."""
    if len(samples) < MIN_SAMPLES:
        return None
    base = _fit(samples, terms, np.zeros(3))
    for _ in terms:  # they scale with the road load
        base = base and _fit(samples, terms, base.theta[:3])
    return None if base is None else Model(samples, terms, base)


def unaligned_residual(model: Model, lag: float) -> Floats:
    """Residual [W] (n,) of the model without a lag, fitted to power that is not aligned: moved back by ``lag`` [s]."""
    base, samples = model.base, model.samples
    others = np.arange(base.X.shape[1]) != LAG
    found = fit_base(base.X[:, others], base.Z[:, others], samples.P - lag * samples.dP, base.block)
    assert found is not None  # a subset of columns that are independent
    return found.residual


def _fit(samples: Samples, terms: tuple[Term, ...], road_load: Floats) -> Base | None:
    if terms and not road_load.any():
        plain = _fit(samples, (), road_load)
        if plain is None:
            return None
        road_load = plain.theta[:3]
    X, Z = columns(samples, terms, road_load)
    return fit_base(X, Z, samples.P, blocks_of(samples.t))

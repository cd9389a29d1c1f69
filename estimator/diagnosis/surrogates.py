"""How often noise alone would give an effect as much evidence: surrogates of the drive at hand.

A surrogate has the speeds and signals of the drive, and the power of its road load plus a residual whose Fourier phases
are drawn anew: noise of the same spectrum in which no effect acts (Theiler et al., Physica D 58, 77, 1992). What the
model lacks and has not named is in that spectrum, which makes the p-value larger.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.diagnosis.model import fit
from estimator.diagnosis.multi_drive import Drive, Joint, ranked
from estimator.diagnosis.thresholds import Thresholds
from estimator.model.design_matrix import PLAIN
from estimator.model.effects import Effect
from estimator.signals import Floats


def p_value(
    ranking: Sequence[Joint],
    final: tuple[Drive, ...],
    effects: Sequence[Effect],
    thresholds: Thresholds,
    count: int,
    rng: np.random.Generator,
) -> float:
    """Share of records whose best effect has as much evidence as in ``ranking``: ``count`` of noise, and this one.

    ``final`` drives have the effects that were named in their models.
    """
    here = _evidence(ranking, thresholds)
    larger = 0
    for _ in range(count):
        drawn = tuple(_surrogate(drive, rng) for drive in final)
        larger += _evidence(ranked(drawn, effects), thresholds) >= here
    return (1 + larger) / (1 + count)


def _evidence(ranking: Sequence[Joint], thresholds: Thresholds) -> float:
    """The largest log Bayes factor, over what it takes to name that effect."""
    return max((j.log_bayes_factor - thresholds.min_log_bf(j.is_timed, others=0) for j in ranking), default=-np.inf)


def _surrogate(drive: Drive, rng: np.random.Generator) -> Drive:
    base, samples = drive.model.base, drive.model.samples
    power = base.X[:, :PLAIN] @ base.theta[:PLAIN] + with_other_phases(base.residual, rng)
    model = fit(replace(samples, P=power))
    return drive if model is None else replace(drive, model=model)


def with_other_phases(x: Floats, rng: np.random.Generator) -> Floats:
    """A series (n,) with the mean and the power spectrum of ``x`` (n,), and random phases."""
    spectrum = np.fft.rfft(x)
    phases = rng.uniform(0.0, 2 * np.pi, len(spectrum))
    phases[0] = 0.0
    if len(x) % 2 == 0:
        phases[-1] = 0.0
    drawn: Floats = np.fft.irfft(spectrum * np.exp(1j * phases), len(x))
    return drawn

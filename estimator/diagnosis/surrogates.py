"""Compute a p-value of the best effect's evidence, by surrogates of the drive.

A surrogate has the speeds and signals of the drive, and the acceleration of its fit plus a residual with random Fourier
phases: noise of the same spectrum in which no effect acts (Theiler et al., Physica D 58, 77, 1992). An effect that the
model lacks is in that spectrum, which makes the p-value larger.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.components.drive_state import DriveState
from estimator.components.search_result import SearchResult, ranked
from estimator.components.term import Frame
from estimator.model.effects import Effect
from estimator.signals import Floats


def p_value(result: SearchResult, count: int, rng: np.random.Generator) -> float:
    """Share of records whose best effect has at least the evidence of the drives' best one.

    Records are ``count`` surrogates and the drives themselves. Given effects act in no surrogate and are no candidates.
    """
    evidence = max((ranked_effect.gain for ranked_effect in result.ranking), default=-np.inf)
    effects = [ranked_effect.effect for ranked_effect in result.ranking]
    larger = 0
    for _ in range(count):
        drawn = [_surrogate(drive, rng) for drive in result.drives]
        larger += best_evidence(drawn, effects) >= evidence
    return (1 + larger) / (1 + count)


def best_evidence(drives: Sequence[DriveState], effects: Sequence[Effect]) -> float:
    """The largest log Bayes factor of an effect alone, less the costs of its times and shapes."""
    return max((ranked_effect.gain for ranked_effect in ranked(drives, effects)), default=-np.inf)


def _surrogate(drive: DriveState, rng: np.random.Generator) -> DriveState:
    fit = drive.fit
    residual = fit.strides.a - fit.fitted
    frame = Frame.of(fit)
    columns = np.column_stack([np.zeros(len(residual)), *(c.columns(frame)[:, 0] for c in drive.chosen)])
    effects = columns[:, 1:] @ drive.magnitudes
    a = drive.strides.a.copy()
    a[drive.strides.known] = fit.fitted - effects + phase_randomised(residual, rng)
    rests = tuple(replace(rest, power=float(rng.normal(0.0, rest.sd))) for rest in drive.rests)
    drawn = DriveState.of(replace(drive.strides, a=a), rests, drive.is_level, fit.scales)
    return drive if drawn is None else drawn


def phase_randomised(x: Floats, rng: np.random.Generator) -> Floats:
    """A series (n,) with the mean and the power spectrum of ``x`` (n,), and random phases."""
    spectrum = np.fft.rfft(x)
    phases = rng.uniform(0.0, 2 * np.pi, len(spectrum))
    phases[0] = 0.0
    if len(x) % 2 == 0:
        phases[-1] = 0.0
    drawn: Floats = np.fft.irfft(spectrum * np.exp(1j * phases), len(x))
    return drawn
